"""Rows that compare the thesis with the library, and how they are judged."""

from __future__ import annotations

import collections
import dataclasses
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Value = bool | int | float | str | tuple[float, ...] | None


ERRATA: dict[str, str] = {
    "E2.1": "(4.23) is the model of an output read half a sample after the held input "
    "changed, or of an input that moves on a line between samples",
    "E2.2": "rows 1 and 2 of (5.7) belong to dead times about 8.54 s shorter than "
    "those of Table 5.1; the shift was chosen to fit, one number for 24 coefficients",
    "E3.1": "in 3.4 the first input coefficient is -1 as in (6.10), not -0.5",
    "E3.2": "the state of (3.2) has (n+1)p + (m-1)q entries",
    "E3.3": "(3.13b): the lower branch adds the lower limit, and the tests are on "
    "-K dx",
    "E4.1": "the reference enters the example of 4.4.2 through the sum of the error "
    "alone (S = 0)",
    "E4.2": "in 4.3.1 K_{m+n} is replaced by +K_I, L(z) starts with the identity, and "
    "R(z) is multiplied by z^{+Np}",
    "E5.1": "w_z of 5.3.2.1 has its entries (2,2) and (2,3) interchanged",
    "E5.2": "Q(3,2) of 5.3.2.2 is 0.0050, not 0.0500",
    "E5.3": "w_u(2,2) of row b is about 0.2575, not 0.005; it was chosen to fit "
    "both entries of the row, which is therefore no independent check",
    "E5.4": "the totals of rows a and b of Table 5.2 are interchanged",
    "E5.5": "the example transfer function below Table 5.1 has time constant and dead "
    "time interchanged",
    "E6.1": "L(z) of 6.2.1 is the identity plus the terms in z^-1, not 1 in each row",
    "E6.2": "(6.5)-(6.7) are [first row]^-1 [second row]",
    "E6.3": "(6.6) holds for a disturbance that the internal model sees as well",
    "E6.4": "figure 6.7 uses Np = 10 and Nc = 5, the lengths of its Q and R",
    "E6.5": "the order of (6.12) is y = CVGAS, MASS, PGAS, TGAS and u = WCHR, WAIR, "
    "WCOL, WSTM",
    "E7.1": "the literal (7.4) counts the present change of v twice",
    "E7.2": "the unit of u1 in 7.4.2 is 100 m3/h: Table 7.4 reads 10 to 25, rate 3.5",
    "E7.3": "G_Delta,1 of Table 7.1 has lr rows",
    "E8.1": "(8.2a) takes d r_{k+1}, as (3.1a) and (8.7) do",
    "E8.2": "Z^{i,j+1} in 8.3.2 is Z^{i,j} times the inverse of A_{k+j}, which a form "
    "with past inputs does not have: predictions are rolled forward",
    "E8.3": "W in 8.3.2 sums Z^{i,Nc+l} b, and goes on with A_{k+i}",
    "E8.4": "each column of Phi_k in (8.5b) carries the b of its own step",
    "E8.5": "in 8.4.1 the reference enters by single terms A^{i-1-l} d, and row Nc + 1 "
    "of Phi_3 ends with A b + b",
    "E8.6": "W-tilde in 8.4.2 sums Z^{i,l} b_{k+l-1}",
    "E8.7": "8.5.1 starts with z = 1, which holds u = 0.3",
    "E8.8": "8.5.2 is at rest with u = sqrt(0.3) and, with an integral, the z that "
    "holds it",
    "E8.9": "with a gain that varies (3.13a) must take the change of k_k x_k, or of "
    "y_{k-1} u_k in 8.5.1, not k_k times the change of x_k",
    "E8.10": "the terminal condition of Proposition 8.4.1 is rest at the reference: "
    "outputs at r and the inputs that parameters depend on at the value that holds "
    "them",
    "E8.11": "optimality for the plant needs the derivative of the parameters with "
    "respect to the plan",
}
"""Corrections that rows refer to."""


YES_NO = "a statement: yes or no"
COUNT = "a count"


PRINTED = "half a unit of the last printed digit"


@dataclass(frozen=True)
class Claim:
    """One printed number or statement, beside ours.

    Parameters
    ----------
    chapter : int
    name : str
        Short and unique.
    where : str
        Section, table or figure.
    statement : str
        What the thesis says, in our words.
    printed, ours : bool, number, text, tuple of numbers, or None
        The thesis's value and the computed one.
    tolerance : float
        Largest difference that counts as agreement.
    reason : str
        Why that tolerance.
    verdict : str
        "reproduced", "reproduced after erratum ...", "differs because ..." or "cannot
        be checked because ...".
    explanation : str
    """

    chapter: int
    name: str
    where: str
    statement: str
    printed: Value
    ours: Value
    tolerance: float
    reason: str
    verdict: str
    explanation: str

    @property
    def kind(self) -> str:
        """First words of the verdict, one of the four."""
        kinds = ("reproduced after", "reproduced", "differs", "cannot")
        return next(kind for kind in kinds if self.verdict.startswith(kind))

    def as_dict(self) -> dict[str, Any]:
        """Fields for JSON; numbers that are not finite become None."""
        return {name: _plain(value) for name, value in dataclasses.asdict(self).items()}


def table(rows: Sequence[Claim]) -> str:
    """Text with a block a row and the counts of the verdicts at the end."""
    blocks = [_block(row) for row in rows]
    counts = collections.Counter(row.kind for row in rows)
    words = {
        "reproduced": "reproduced",
        "reproduced after": "reproduced after an erratum",
        "differs": "differ",
        "cannot": "cannot be checked",
    }
    summary = ", ".join(f"{counts[kind]} {words[kind]}" for kind in words)
    return "\n".join([*blocks, f"{len(rows)} rows: {summary}"])


def _block(row: Claim) -> str:
    head = f"{row.where:<16} {row.name}"
    values = f"printed {_text(row.printed)}, ours {_text(row.ours)}"
    if math.isfinite(row.tolerance):
        values += f", tolerance {row.tolerance:.3g} ({row.reason})"
    lines = [row.statement, values, f"=> {row.verdict}", row.explanation]
    wrapped = (
        textwrap.wrap(line, 84, initial_indent="    ", subsequent_indent="    ")
        for line in lines
    )
    return "\n".join([head, *(line for lines in wrapped for line in lines), ""])


def _text(value: Value) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, tuple):
        return "[" + " ".join(f"{entry:.5g}" for entry in value) + "]"
    return "-" if value is None else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value


def _agree(printed: Value, ours: Value, tolerance: float) -> bool:
    if isinstance(printed, bool | str) or isinstance(ours, bool | str):
        return printed == ours
    if printed is None or ours is None:
        return False
    gap = np.asarray(printed, dtype=float) - np.asarray(ours, dtype=float)
    return bool((np.abs(gap) <= tolerance).all())


def claim(
    where: str,
    name: str,
    statement: str,
    printed: Any,
    ours: Any,
    tolerance: float = 0.0,
    reason: str = "",
    erratum: str = "",
    because: str = "",
    note: str = "",
) -> Claim:
    """Make a row with the verdict that printed, ours and tolerance give.

    ``erratum`` names the correction with which ours was computed; ``because`` explains
    a difference and is used only if there is one.
    """
    printed, ours = _bare(printed), _bare(ours)
    if _agree(printed, ours, tolerance):
        verdict = f"reproduced after erratum {erratum}" if erratum else "reproduced"
    else:
        verdict = f"differs because {because or UNEXPLAINED}"
    explanation = f"{erratum}: {ERRATA[erratum]}. {note}" if erratum else note
    return Claim(
        int(where[0]),
        name,
        where,
        statement,
        printed,
        ours,
        float(tolerance),
        reason or (YES_NO if isinstance(printed, bool) else COUNT),
        verdict,
        explanation.strip(),
    )


UNEXPLAINED = "of something not yet understood"


def unchecked(
    where: str,
    name: str,
    statement: str,
    because: str,
    printed: Any = None,
    ours: Any = None,
    note: str = "",
) -> Claim:
    """Make a row that nobody without the missing data can decide."""
    return Claim(
        int(where[0]),
        name,
        where,
        statement,
        _bare(printed),
        _bare(ours),
        math.nan,
        "none",
        f"cannot be checked because {because}",
        note,
    )


def _bare(value: Any) -> Value:
    """Turn numpy values into plain Python ones."""
    if isinstance(value, np.ndarray | tuple | list):
        return tuple(float(entry) for entry in np.ravel(value))
    if isinstance(value, np.generic):
        plain: Value = value.item()
        return plain
    bare: Value = value
    return bare
