"""A design: everything chosen about a controller, as data that builds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nmss_lab.controller import Controller, Limits
from nmss_lab.governor import governor
from nmss_lab.models import DifferenceModel
from nmss_lab.mpc import STRUCTURES, Reading
from nmss_lab.pip import pip
from nmss_lab.predict import Horizon


@dataclass(frozen=True, eq=False)
class Design:
    """Choices that make a controller.

    Parameters
    ----------
    structure : str
        A name in ``nmss_lab.mpc.STRUCTURES``, or "pip", or "governor".
    model : DifferenceModel
    horizon : Horizon
        Not used by "pip"; "governor" uses its Np.
    Q, R : weights, as the structure takes them
        Not used by "pip" and "governor".
    limits : Limits
    reference : Reading
        What is known of the reference ahead.
    options : mapping
        Further arguments of the structure's function: ``terminal``, ``observer``,
        ``forecast``, ``backend``; ``K``, ``law``, ``path`` for "pip"; ``K``,
        ``free_until``, ``decay`` for "governor".

    Raises
    ------
    ValueError
        If there is no such structure.
    """

    structure: str
    model: DifferenceModel
    horizon: Horizon = field(default_factory=lambda: Horizon(10, 3))
    Q: Any = 1.0
    R: Any = 1.0
    limits: Limits = field(default_factory=Limits)
    reference: Reading = "held"
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse an unknown structure."""
        names = (*STRUCTURES, "pip", "governor")
        if self.structure not in names:
            raise ValueError(
                f'structure = "{self.structure}": expected one of {", ".join(names)}'
            )

    def build(self) -> Controller:
        """Build the controller; errors are those of the structure's function."""
        options = dict(self.options)
        if self.structure == "pip":
            return pip(self.model, limits=self.limits, **options)
        if self.structure == "governor":
            return governor(
                self.model,
                Np=self.horizon.Np,
                limits=self.limits,
                reference="preview" if self.reference == "preview" else "held",
                **options,
            )
        return STRUCTURES[self.structure](
            self.model,
            self.horizon,
            self.Q,
            self.R,
            self.limits,
            self.reference,
            **options,
        )
