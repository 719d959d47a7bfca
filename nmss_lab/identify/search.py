"""Which orders and which delay: every structure in a range, ranked."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from nmss_lab.identify.estimate import Estimate
from nmss_lab.identify.fit import riv, sriv
from nmss_lab.identify.structure import Noise, Orders, Start, inputs_of
from nmss_lab.parallel import in_order
from nmss_lab.records import Record

if TYPE_CHECKING:
    import pandas

Progress = Callable[[int, int], bool | None]
"""Called with (done, total) after each fit; returning True stops the search."""

CRITERIA = ("yic", "bic", "r2_t", "aic", "passes")


@dataclass(frozen=True, eq=False)
class Candidate:
    """One row of an order search: an estimate, or the reason why there is none."""

    orders: Orders
    estimate: Estimate | None
    problem: str

    @property
    def row(self) -> dict[str, Any]:
        """Orders, criteria and problem, for a table; no criterion is nan."""
        row: dict[str, Any] = {
            "orders": str(self.orders),
            "parameters": self.orders.count,
        }
        for name in CRITERIA:
            row[name] = getattr(self.estimate, name) if self.estimate else np.nan
        return {**row, "problem": self.problem}


def structures(
    inputs: int, na: Sequence[int], nb: Sequence[int], nk: Sequence[int]
) -> list[Orders]:
    """Every combination of orders; each input takes each nb and nk in turn."""
    return [
        Orders(n, b, k)
        for n in na
        for b in itertools.product(nb, repeat=inputs)
        for k in itertools.product(nk, repeat=inputs)
    ]


def order_search(
    record: Record,
    na: Sequence[int],
    nb: Sequence[int],
    nk: Sequence[int],
    noise: Noise | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    start: Start = "rest",
) -> list[Candidate]:
    """Fit every combination of orders and rank them by YIC, failures last.

    Parameters
    ----------
    record : Record
    na, nb, nk : sequences of int
        Orders to try; every input takes each nb and nk in turn.
    noise : Noise, optional
        Fit with ``riv``; ``sriv`` without.
    executor : concurrent.futures.Executor, optional
        Where to fit; in this process if absent.
    progress : Progress, optional
        What is done when it stops the search is kept.
    start : Start

    Returns
    -------
    list of Candidate
        ``table`` makes a DataFrame of it.

    Raises
    ------
    ValueError
        If the record has no inputs.
    """
    tries = structures(inputs_of(record).shape[1], na, nb, nk)
    done: list[Candidate] = []
    fit = functools.partial(_try, record, noise, start)
    with closing(in_order(fit, tries, executor)) as fitted:
        for candidate in fitted:
            done.append(candidate)
            if progress is not None and progress(len(done), len(tries)):
                break
    return sorted(done, key=_rank)


def table(candidates: Sequence[Candidate]) -> pandas.DataFrame:
    """Candidates as a DataFrame, one row each, in their order."""
    import pandas

    return pandas.DataFrame([candidate.row for candidate in candidates])


def delay_profile(
    estimate: Estimate, delays: Sequence[int], channel: int = 0
) -> dict[int, float]:
    """How probable each delay of one input is, all else fitted anew.

    Parameters
    ----------
    estimate : Estimate
        Says record, orders, noise model and start.
    delays : sequence of int
        Samples to compare, equally probable beforehand.
    channel : int
        Which input, counted from 0.

    Returns
    -------
    dict from delay to probability
        From the likelihood of the innovations, which should be white; zero where no
        stable model was found.

    Raises
    ------
    ValueError
        If no delay gave a stable model.
    """
    noise = Noise(len(estimate.noise_c) - 1, len(estimate.noise_d) - 1)
    noise_or_none = noise if estimate.method == "riv" else None
    orders, found = estimate.orders, {}
    for delay in delays:
        nk = (*orders.nk[:channel], delay, *orders.nk[channel + 1 :])
        tried = replace(orders, nk=nk)
        fitted = _try(estimate.record, noise_or_none, estimate.start, tried)
        if fitted.estimate is not None and fitted.estimate.is_good:
            found[delay] = fitted.estimate.aic
    if not found:
        raise ValueError(f"delays = {list(delays)}: none of them gave a stable model")
    best = min(found.values())
    weight = {k: float(np.exp(-(found.get(k, np.inf) - best) / 2.0)) for k in delays}
    return {k: w / sum(weight.values()) for k, w in weight.items()}


def _try(
    record: Record, noise: Noise | None, start: Start, orders: Orders
) -> Candidate:
    try:
        found = (
            sriv(record, orders, start)
            if noise is None
            else riv(record, orders, noise, start)
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        return Candidate(orders, None, str(error))
    return Candidate(orders, found, found.problem)


def _rank(candidate: Candidate) -> tuple[bool, float]:
    found = candidate.estimate
    if found is None or np.isnan(found.yic):
        return True, np.inf
    return not found.is_good, found.yic
