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
from nmss_lab.sdp import sdp_governor, sdp_pip
from nmss_lab.sdp_mpc import SDP_STRUCTURES
from nmss_lab.state_dependent import StateDependentModel

VARYING = (*SDP_STRUCTURES, "sdp_pip", "sdp_governor")
"""Structures for a state-dependent model; all others take a difference equation."""


@dataclass(frozen=True, eq=False)
class Design:
    """Choices that make a controller.

    Parameters
    ----------
    structure : str
        A name in ``nmss_lab.mpc.STRUCTURES``, or "pip", or "governor"; for a
        state-dependent model one of ``VARYING``.
    model : DifferenceModel or StateDependentModel
    horizon : Horizon
        Not used by "pip" and "sdp_pip"; governors use its Np.
    Q, R : weights, as the structure takes them
        Not used by "pip" and "governor"; nor by "sdp_pip" and "sdp_governor" where
        ``options`` name poles.
    limits : Limits
    reference : Reading
        What is known of the reference ahead.
    options : mapping
        Further arguments of the structure's function: ``terminal``, ``observer``,
        ``forecast``, ``backend``; ``K``, ``law``, ``path`` for "pip"; ``K``,
        ``free_until``, ``decay`` for "governor"; ``settling``, ``offset_free`` for
        the predictive structures of a state-dependent model, ``poles`` for its PIP.

    Raises
    ------
    ValueError
        If there is no such structure, or it is not for this kind of model.
    """

    structure: str
    model: DifferenceModel | StateDependentModel
    horizon: Horizon = field(default_factory=lambda: Horizon(10, 3))
    Q: Any = 1.0
    R: Any = 1.0
    limits: Limits = field(default_factory=Limits)
    reference: Reading = "held"
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse an unknown structure."""
        names = (*STRUCTURES, "pip", "governor", *VARYING)
        if self.structure not in names:
            raise ValueError(
                f'structure = "{self.structure}": expected one of {", ".join(names)}'
            )
        varies = isinstance(self.model, StateDependentModel)
        if varies != (self.structure in VARYING):
            kind = "state-dependent model" if varies else "difference equation"
            fitting = VARYING if varies else names[: -len(VARYING)]
            raise ValueError(
                f'structure = "{self.structure}" does not take a {kind}; expected one '
                f"of {', '.join(fitting)}"
            )

    def build(self) -> Controller:
        """Build the controller; errors are those of the structure's function."""
        options = dict(self.options)
        if isinstance(self.model, StateDependentModel):
            return self._build_varying(self.model, options)
        if self.structure in ("pip", "governor") and "K" not in options:
            raise ValueError(
                f'structure = "{self.structure}": options have no gain "K"; lq_gain '
                "and pole_gain find one"
            )
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

    def _build_varying(
        self, model: StateDependentModel, options: dict[str, Any]
    ) -> Controller:
        if self.structure in SDP_STRUCTURES:
            return SDP_STRUCTURES[self.structure](
                model,
                self.horizon,
                self.Q,
                self.R,
                self.limits,
                self.reference,
                **options,
            )
        if "poles" not in options:
            options |= {"Q": self.Q, "R": self.R}
        if self.structure == "sdp_pip":
            return sdp_pip(model, limits=self.limits, **options)
        return sdp_governor(
            model,
            Np=self.horizon.Np,
            limits=self.limits,
            reference="preview" if self.reference == "preview" else "held",
            **options,
        )
