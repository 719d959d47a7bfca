"""Shadow prices against programs that are solved again with more room."""

import numpy as np
import pytest

from nmss_lab.cases import case
from nmss_lab.controller import Status
from nmss_lab.predictive import PredictiveController
from nmss_lab.prices import Price, prices
from nmss_lab.qp import solve
from nmss_lab.simulate import Run, closed_loop

LIMITED = (
    ("ifac93_6_3_3", "wang_young"),
    ("gasifier_6_3_4", "wang_young"),
    ("governor_3_4", "governor"),
    ("temperature_7_4_2", "disturbance_direct"),
)


def run_of(name: str, structure: str) -> Run:
    """Run one design of a case."""
    example = case(name)
    return closed_loop(
        example.plant, example.designs[structure].build(), example.scenario
    )


def solved(run: Run, k: int, price: Price, room: float) -> tuple[float, np.ndarray]:
    """Cost and first move with more room in one row, from another solver."""
    controller = run.controller
    assert isinstance(controller, PredictiveController)
    program, known = controller.program, run.moves.known[k]
    low, high = program.lower.copy(), program.upper.copy()
    row = program.labels.index(price.row)
    if price.upper:
        high[row] += room
    else:
        low[row] -= room
    found = solve(program, known, "qpsolvers/quadprog", (low, high))
    assert found.found
    move = controller.first_move.value(found.decision, known)
    return float(program.cost(found.decision, known)), move


@pytest.mark.parametrize(("name", "structure"), LIMITED)
def test_prices_are_those_of_programs_with_more_room(name: str, structure: str) -> None:
    """Cost and move change as told, up to where it is said to end."""
    run, checked = run_of(name, structure), 0
    for k in np.flatnonzero(run.active.any(axis=1))[::7]:
        for price in prices(run, int(k))[:4]:
            room = min(price.up_to, 1.0) / 2.0
            if room < 1e-6:
                continue
            costs, moves = zip(
                *(solved(run, k, price, x) for x in (0.0, room, 2.0 * room)),
                strict=True,
            )
            # J is quadratic in the room there: three points give the slope at none
            slope = (3.0 * costs[0] - 4.0 * costs[1] + costs[2]) / (2.0 * room)
            # digits that are lost where costs are subtracted
            lost = 1e-10 * (1.0 + abs(costs[0])) / room
            assert slope == pytest.approx(price.saving, rel=1e-6, abs=lost)
            change = (moves[1] - moves[0]) / room
            assert change == pytest.approx(price.move, rel=1e-6, abs=1e-8 / room)
            checked += 1
    assert checked > 0


def test_other_limits_hold_beyond() -> None:
    """Past the room that is told, the move is another one."""
    run = run_of("ifac93_6_3_3", "wang_young")
    k = int(np.flatnonzero(run.active.any(axis=1))[0])
    price = prices(run, k)[0]
    _, before = solved(run, k, price, price.up_to)
    _, after = solved(run, k, price, price.up_to + 0.1)
    assert np.abs(after - before - 0.1 * price.move).max() > 1e-3


def test_dearest_first_and_nothing_without_limits() -> None:
    """Prices fall along the list; a free sample has none, nor a law without plans."""
    run = run_of("gasifier_6_3_4", "wang_young")
    k = int(run.active.sum(axis=1).argmax())
    found = [price.saving for price in prices(run, k)]
    assert len(found) == run.active[k].sum()
    assert found == sorted(found, reverse=True)
    free = run_of("ifac93_6_3_3", "wang_young")
    assert prices(free, int(np.flatnonzero(free.status == Status.FREE)[0])) == []
    assert prices(run_of("governor_3_4", "pip"), 8) == []
    with pytest.raises(ValueError, match="k = 5000"):
        prices(run, 5000)


def test_varying_plant_tells_cost_alone() -> None:
    """Where the program depends on the plan, no law of the move is told."""
    run = run_of("conical_tank", "iterated")
    k = int(np.flatnonzero(run.active.any(axis=1))[0])
    price = prices(run, k)[0]
    assert price.saving > 0.0
    assert np.isnan(price.move).all()
    assert np.isnan(price.up_to)
