"""Chapter 8: plants whose parameters depend on the state."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.linalg

from nmss_lab.controller import Limits, Status
from nmss_lab.convergence import best_plan, examine, iterates, trail_mismatch
from nmss_lab.design import Design
from nmss_lab.models import Array
from nmss_lab.mpc import integral_of_error
from nmss_lab.predict import Horizon
from nmss_lab.predictive import PredictiveController
from nmss_lab.reproduce.recursions import TOPICS_8_3, TOPICS_8_4
from nmss_lab.reproduce.rows import Claim, claim, unchecked
from nmss_lab.reproduce.shared import case_of, keeps_limits, simulated
from nmss_lab.reproduce.varying_pip import (
    EXACT,
    PRODUCT,
    TOPICS_8_2,
    frozen_product,
    model_of,
)
from nmss_lab.sdp_mpc import Settling, StateDependentController
from nmss_lab.sdp_problem import Problem
from nmss_lab.simulate import Run, Scenario

# 8.3 and 8.4: predictive control


def _product(
    name: str,
    settling: Settling | None = None,
    scenario: Scenario | None = None,
    terminal: str = "none",
    **changes: Any,
) -> Run:
    case = case_of(PRODUCT)
    design: Design = case.designs[name]
    options = {**design.options, "terminal": terminal}
    if settling is not None:
        options["settling"] = settling
    design = dataclasses.replace(design, options=options, **changes)
    return simulated(design, case.plant, scenario or case.scenario)


@functools.cache
def _run(name: str) -> Run:
    """Run a design of 8.5.2 as the case has it, once."""
    return _product(name)


def _problem(run: Run) -> Problem:
    assert isinstance(run.controller, StateDependentController)
    return run.controller.problem


def _theta(run: Run, k: int) -> Array:
    assert run.moves is not None
    known: Array = run.moves.known[k, : _problem(run).known.size]
    return known


STEP = 5
"""Sample of 8.5.2 at which the reference goes from 1 to 2."""

AFTER = slice(STEP + 1, None)
"""Samples at which the reference has been 2 for a while."""


def _frozen_8_3() -> Iterator[Claim]:
    run, k = _run("integral_frozen"), 8
    design = case_of(PRODUCT).designs["integral_frozen"]
    past = float(run.u[k - 1, 0])
    linear = integral_of_error(frozen_product(past), design.horizon, design.Q, design.R)
    theta = _theta(run, k)
    program = _problem(run).at(np.zeros(8), theta, "frozen").program
    known = _problem(run).known
    x = np.concatenate([run.y[k], theta[known["x"]][-1:]])
    there = np.zeros(linear.knowledge.layout.size)
    for part, value in (("x", x), ("u", past), ("r", run.r[k])):
        there[linear.knowledge.layout[part]] = value
    gap = max(
        np.abs(program.H - linear.program.H).max(),
        np.abs(program.f @ theta - linear.program.f @ there).max(),
    )
    yield claim(
        "8.3.1, (8.4)",
        "frozen program",
        "with the frozen model the program is (4.16); largest difference of H and f "
        "at a sample of 8.5.2",
        0.0,
        gap,
        *EXACT,
    )
    for name in ("frozen", "integral_frozen"):
        trail = _run(name).trail("y")[1:-1, 0]
        yield claim(
            "8.3.2",
            f"first step, {name.replace('_', ', ')}",
            "also with the frozen model the next state is the predicted one",
            0.0,
            np.abs(trail - _run(name).y[2:]).max(),
            *EXACT,
        )


def _plan_errors(run: Run) -> Array:
    """Predicted outputs minus those of the plant under the plan, (samples, Np)."""
    assert run.moves is not None
    problem, trail = _problem(run), run.trail("y")[:, :, 0]
    real = [
        problem.rolled(run.moves.decision[k], _theta(run, k))[1][:, 0]
        for k in range(len(run))
    ]
    errors: Array = trail - np.array(real)
    return errors[1:]


def _predictions() -> Iterator[Claim]:
    for title, frozen, iterated in (
        ("8.3", "integral_frozen", "integral_iterated"),
        ("8.4", "frozen", "iterated"),
    ):
        errors = {name: _plan_errors(_run(name)) for name in (frozen, iterated)}
        yield claim(
            "8.3.2",
            f"predictions of the frozen model, {title}",
            "further ahead the frozen predictions err (RMS above 0.05 under the plan's "
            "own inputs)",
            True,
            _rms(errors[frozen]) > 0.05,
            note=f"RMS {_rms(errors[frozen]):.3f}",
        )
        yield claim(
            "8.3.2",
            f"converged predictions, {title}",
            "once converged, predictions are what the plant does under the plan; "
            "largest difference",
            0.0,
            np.abs(errors[iterated]).max(),
            1e-7,
            "passes end at a change of 1e-8",
        )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _apart(run: Run) -> Array:
    """Differences of predictions a sample apart, without the step of the reference."""
    return np.delete(trail_mismatch(run), [0, 1, STEP])


def _trails() -> Iterator[Claim]:
    where = "8.5.2, fig. 8.6"
    frozen, iterated = _apart(_run("frozen")), _apart(_run("iterated"))
    yield claim(
        where,
        "frozen trails",
        "predictions of samples next to each other differ considerably (RMS above "
        "5 % of the step of 1 at some sample)",
        True,
        frozen.max() > 0.05,
        note=f"RMS over all samples {_rms(frozen):.4f}, at the worst "
        f"{frozen.max():.3f}, the sample of the step left out",
    )
    yield claim(
        where,
        "iterated trails",
        "after Algorithm 8.3.1 they cannot be told apart (RMS below 0.5 % of the step, "
        "a line's width)",
        True,
        iterated.max() < 0.005,
        note=f"RMS over all samples {_rms(iterated):.5f}, "
        f"{_rms(frozen) / _rms(iterated):.0f} times less than frozen",
    )
    held, moved = _apart(_run("integral_frozen")), _apart(_run("integral_iterated"))
    end = float(_run("integral_iterated").trail("y")[-1, -1, 0])
    yield claim(
        "8.3.2, 8.5.2",
        "trails with the integral",
        "the improvement is drastic (below a tenth) with the integral of 8.3, too",
        True,
        _rms(moved) < 0.1 * _rms(held),
        because="each plan comes true on its own, but the next sample makes another "
        f"one: RMS {_rms(moved):.3f} against {_rms(held):.3f} frozen; the cost weighs "
        "y, z and u themselves, so that a plan lets the output go towards its end, "
        f"even at rest: to {end:.2f} in place of 2 at the last sample",
        note="the passes converge all the same: trails that differ do not tell",
    )


def _figures() -> Iterator[Claim]:
    for figure, name, title in (
        ("8.5.2, fig. 8.3", "integral_iterated", "integral"),
        ("8.5.2, fig. 8.5", "frozen", "frozen"),
        ("8.5.2", "iterated", "iterated"),
    ):
        run = _run(name)
        yield claim(
            figure,
            f"reaches 2, {title}",
            "a stable response that reaches 2",
            2.0,
            run.y[-1, 0],
            0.002,
            "0.1 % of the step's end",
            note=f"from 1, limits reached at {int((run.status != 0).sum())} samples",
        )
        yield claim(
            figure,
            f"limits kept, {title}",
            "input and rate stay within their limits",
            True,
            keeps_limits(run),
        )
    gap = np.abs(_run("frozen").y - _run("iterated").y).max()
    yield claim(
        "8.5.2",
        "frozen and iterated alike",
        "the response with the improved predictions is very much that without; "
        "largest difference",
        0.0,
        gap,
        0.05,
        "5 % of the step",
    )
    lags = [int((_run(name).iterations[1:]).max()) for name in ("frozen", "iterated")]
    yield claim(
        "8.1",
        "more work",
        "the improved predictions take more computing than the frozen model",
        True,
        lags[1] > lags[0],
        note=f"at most {lags[1]} programs a sample against {lags[0]}",
    )


def _starts_8_5_2() -> Iterator[Claim]:
    hand = np.full(30, np.nan)
    hand[0] = 0.547
    printed = Scenario(np.ones(30), manual=hand, y0=1.0, u0=0.547, z0=0.0)
    rest = Scenario(np.ones(30), y0=1.0, u0=np.sqrt(0.3))
    name = "integral_iterated"
    yield claim(
        "8.5.2",
        "start, as printed",
        "(y, u, u, z) = (1, 0.547, 0.547, 0), taken as the rest before the step: "
        "largest move of y under the controller of 8.3 while r stays 1",
        0.0,
        np.abs(_product(name, scenario=printed).y - 1.0).max(),
        0.01,
        "1 % of the set-point",
        because="u = 0.547 is sqrt(0.3) rounded, but z = 0 is not the sum that holds "
        "it; see E8.8",
    )
    run = _product(name, scenario=rest)
    z = _theta(run, 1)[_problem(run).known["x"]][-1]
    yield claim(
        "8.5.2",
        "start, at rest",
        "the same from u = sqrt(0.3) and the sum that holds it",
        0.0,
        np.abs(run.y - 1.0).max(),
        1e-6,
        "passes end at a change of 1e-8",
        erratum="E8.8",
        note=f"z = {z:.4f}",
    )


def _costs() -> Iterator[Claim]:
    run = _run("integral_iterated")
    rises = int((np.diff(run.cost[AFTER]) > 1e-9 * run.cost[-1]).sum())
    pairs = len(run.cost[AFTER]) - 1
    yield claim(
        "8.5.2, fig. 8.4",
        "cost not monotone",
        "with the integral the cost does not fall at every sample",
        True,
        rises > 0,
        note=f"it rises at {rises} of {pairs} samples while r is 2",
    )
    broken = int((_assumption_8_3_3(run)[AFTER] > 1e-9).sum())
    yield claim(
        "8.5.2",
        "Assumption 8.3.3 fails",
        "that is where Assumption 8.3.3 is not met",
        True,
        broken > 0,
        note=f"it fails at {broken} of {pairs + 1} samples while r is 2",
    )
    still = Scenario(np.full(3, 2.0), y0=2.0, u0=np.sqrt(0.6))
    yield claim(
        "8.3.3",
        "cost at rest",
        "the cost is a positive definite function about the set-point: zero at rest "
        "there; here at r = 2",
        0.0,
        _product("integral_iterated", scenario=still).cost[-1],
        1e-6,
        "passes end at a change of 1e-8",
        because="it weighs y, z and u themselves, none of which is zero at rest: no "
        "Lyapunov function for a set-point other than zero, whether or not "
        "Assumption 8.3.3 holds",
    )
    yield from _monotone()


def _assumption_8_3_3(run: Run) -> Array:
    """Left side of Assumption 8.3.3 at each sample."""
    assert run.moves is not None
    problem, design = _problem(run), case_of(PRODUCT).designs["integral_iterated"]
    q_y, q_z = design.Q
    found = []
    for k in range(len(run)):
        theta = _theta(run, k)
        U, y = (part[:, 0] for part in problem.rolled(run.moves.decision[k], theta))
        last = U[-1]
        y = np.append(y, 0.7 * y[-1] + last * last)
        z = theta[problem.known["x"]][-1] + np.cumsum(run.r[k, 0] - y)
        state = q_y * y**2 + q_z * z**2
        found.append(state[-1] + design.R * last**2 - state[0] - design.R * U[0] ** 2)
    return np.array(found)


def _monotone() -> Iterator[Claim]:
    rising = ", ".join(str(Np) for Np in range(1, 10) if not _falls("iterated", Np))
    frozen = "falls as well" if _falls("frozen", 10) else "does not"
    yield claim(
        "8.5.2, fig. 8.7",
        "cost monotone",
        "with changes of the input and improved predictions the cost falls at every "
        "sample after the step",
        True,
        _falls("iterated", 10),
        note=f"with Np = 10; among shorter horizons (Nc = min(Np, 8)) not with Np = "
        f"{rising}; the frozen cost, by its own predictions, {frozen}",
    )


def _falls(name: str, Np: int) -> bool:
    horizon = Horizon(Np, min(Np, 8))
    run = _run(name) if Np == 10 else _product(name, horizon=horizon)
    cost = run.cost[STEP:]
    return bool((np.diff(cost) <= 1e-9 * cost[0]).all())


# Algorithm 8.3.1


PLAIN = Settling("iterated", damping=0.0, passes=200)

COLD = dataclasses.replace(PLAIN, warm_start=False)

ENDED = {int(Status.FREE), int(Status.LIMITED)}


def _passes(name: str, settling: Settling) -> Run:
    """First 21 samples of 8.5.2 under a way to settle."""
    whole = case_of(PRODUCT).scenario
    short = dataclasses.replace(
        whole, reference=whole.reference[:21], manual=whole.of("manual", 1)[:21]
    )
    return _product(name, settling, short)


def _alternates(run: Run, k: int) -> bool:
    """Whether passes of a sample go to and fro in the end."""
    plans = np.array([each.u.ravel() for each in iterates(run, k)[-6:]])
    ways = np.diff(plans, axis=0)
    return bool(((ways[1:] * ways[:-1]).sum(axis=1) < 0.0).all())


FORMS = (("8.3", "integral_iterated"), ("8.4", "iterated"))


def _convergence() -> Iterator[Claim]:
    for title, name in FORMS:
        plain, cold = _passes(name, PLAIN), _passes(name, COLD)
        counts = {
            damping: _passes(name, dataclasses.replace(PLAIN, damping=damping))
            for damping in (0.3, 0.5)
        }
        told = ", ".join(
            f"{run.iterations[1:].mean():.0f} with damping {damping}"
            for damping, run in counts.items()
        )
        factor = float(np.nanmedian(examine(plain).contraction))
        sense = "opposite" if _alternates(plain, STEP + 3) else "the same"
        yield claim(
            "8.5.2",
            f"passes converge, {title}",
            "Algorithm 8.3.1 converges at every sample (to 1e-8; 20 samples)",
            True,
            set(plain.status[1:].tolist()) <= ENDED,
            note=f"{plain.iterations[1:].mean():.0f} passes on average, at most "
            f"{plain.iterations[1:].max()}: each change is {factor:.2f} times the one "
            f"before, in {sense} direction; {told}",
        )
        saved = cold.iterations[1:].sum() / plain.iterations[1:].sum()
        yield claim(
            "8.3.2",
            f"start from the last plan, {title}",
            "starting from the rest of the last plan saves passes (more than 5 %)",
            True,
            bool(saved > 1.05),
            because="each sample makes another plan, so that the last one is no better "
            "a start than the frozen optimum",
            note=f"{cold.iterations[1:].mean():.1f} passes on average without, "
            f"{plain.iterations[1:].mean():.1f} with",
        )
    yield from _no_guarantee()


def _no_guarantee() -> Iterator[Claim]:
    short: dict[str, Any] = {"horizon": Horizon(10, 6), "R": 0.01}
    there = Scenario(np.full(2, 0.2), y0=1.0, u0=np.sqrt(0.3))
    plain, damped = (
        _product("iterated", settling, there, **short)
        for settling in (PLAIN, dataclasses.replace(PLAIN, damping=0.3))
    )
    yield claim(
        "8.4.3, Remark 8.4.1",
        "no guarantee of convergence",
        "the passes need not converge; here r = 0.2 from rest at 1, Nc = 6, R = 0.01, "
        "else as fig. 8.5",
        True,
        bool((plain.status == Status.CYCLED).all()),
        note=f"two plans in turn; with damping 0.3 it ends after "
        f"{damped.iterations.max()} passes at most",
    )
    scenario = case_of(PRODUCT).scenario
    mirrored = dataclasses.replace(
        scenario, manual=-scenario.of("manual", 1), u0=-0.547
    )
    for title, name in FORMS:
        run, twin = _run(name), _product(name, scenario=mirrored)
        yield claim(
            "8.5.2, 9.2.2",
            f"two solutions, {title}",
            "solutions come in pairs; here u and -u do the same: largest difference of "
            "the outputs when all inputs change sign",
            0.0,
            max(np.abs(run.y - twin.y).max(), np.abs(run.u + twin.u).max()),
            *EXACT,
        )
    trapped = _product("iterated", scenario=Scenario(np.ones(20), y0=1.0, u0=0.0))
    yield claim(
        "8.5.2, 9.2.2",
        "loss of controllability",
        "there are starts from which control is lost; here u_{k-1} = 0",
        True,
        bool((trapped.status == Status.GUARDED).all() and trapped.y[-1, 0] < 0.01),
        note="b_k = 0: no pass sees that two changes of the input would act; u stays "
        "0 and y falls to 0",
    )


TRUE = {"integral_iterated": "integral_newton", "iterated": "gauss_newton"}
"""Designs whose passes take the derivative of the parameters into account."""

LOOKED_AT = (6, 7, 8, 9, 12)
"""Samples at which the best plan is looked for."""


def _worst_gap(name: str) -> float:
    """Largest share by which a plan's cost exceeds the best plan's."""
    run, worst = _run(name), 0.0
    assert run.moves is not None
    for k in LOOKED_AT:
        best = best_plan(run, k, starts=1).cost
        point = _problem(run).at(run.moves.decision[k], _theta(run, k), "gauss-newton")
        worst = max(worst, (point.cost - best) / best)
    return worst


def _optimality() -> Iterator[Claim]:
    for title, name in FORMS:
        for which, erratum in ((name, ""), (TRUE[name], "E8.11")):
            found = examine(_run(which))
            yield claim(
                "8.3.2",
                f"optimal for the plant, {title}" + (", derivative" * bool(erratum)),
                "the converged law is optimal for the non-linear plant: largest share "
                "by which a better plan is cheaper",
                0.0,
                _worst_gap(which),
                1e-7,
                "what the search for the best plan resolves",
                erratum=erratum,
                because="a fixed point is optimal for parameters that the plan does "
                "not move; the derivative of the parameters is missing, see E8.11",
                note="projected gradient of the true cost, at most "
                f"{np.nanmax(found.stationarity[1:]):.1e}; five samples, "
                "six starts each",
            )
    yield from _promises()


def _broken_promises(run: Run) -> list[int]:
    """Find samples whose cost is above that of the last plan, shifted by a sample.

    Costs below a billionth of the largest are left out: rounding decides there.
    """
    promised = examine(run).promised
    counted = np.arange(len(run)) > STEP
    counted &= promised > 1e-9 * run.cost[AFTER].max()
    above = run.cost > promised * (1.0 + 1e-6)
    return [int(k) for k in np.flatnonzero(counted & above)]


def _promises() -> Iterator[Claim]:
    run = _run("integral_iterated")
    promised = examine(run).promised[AFTER]
    change = promised - run.cost[STEP:-1]
    gap = change - _assumption_8_3_3(run)[STEP:-1]
    yield claim(
        "8.3.3",
        "cost of the shifted plan",
        "repeating the last input changes the cost by the left side of Assumption "
        "8.3.3; largest difference",
        0.0,
        np.abs(gap).max(),
        1e-5,
        "passes end at a change of 1e-8, costs are about 100",
    )
    yield claim(
        "8.3.3",
        "bound of the proof",
        "the next cost is not above that of the shifted plan; samples at which it is",
        0,
        len(_broken_promises(run)),
    )
    for name, erratum in (("iterated", ""), ("gauss_newton", "E8.11")):
        run = _run(name)
        broken = _broken_promises(run)
        excess = (run.cost / examine(run).promised - 1.0)[broken].max(initial=0.0)
        yield claim(
            "8.4.3",
            "bound of the proof" + (", derivative" if erratum else ""),
            "the next cost is not above that of the plan with a zero change appended; "
            "samples at which it is",
            0,
            len(broken),
            erratum=erratum,
            because="the next plan is a fixed point and no optimum for the plant, so "
            f"the shifted plan may be cheaper; at samples {broken}, by up to "
            f"{100 * excess:.2f} %; see E8.11",
        )


# Stability


def _increments_8_4() -> Iterator[Claim]:
    yield claim(
        "8.4.1",
        "no form in differences",
        "(8.1) can in general not be written in differences of outputs and inputs: "
        "the frozen model in differences misses the next output of 8.5.2",
        True,
        _missed_in_differences() > 1e-3,
        note=f"by up to {_missed_in_differences():.3f}",
    )
    run, k = _run("frozen"), 8
    design = case_of(PRODUCT).designs["frozen"]
    limits = dataclasses.replace(design.limits, y=(0.0, 2.5))
    wide = dataclasses.replace(design, limits=limits).build()
    assert isinstance(wide, StateDependentController)
    program = wide.problem.at(np.zeros(8), _theta(run, k), "frozen").program
    M, N, H, f = _printed_8_9(run, k, limits)
    moves = np.random.default_rng(8).uniform(-0.2, 0.2, (50, 8))
    ours = [float(program.room(z, _theta(run, k)).min()) for z in moves]
    printed = (N - moves @ M.T).min(axis=1)
    best = np.linalg.solve(program.H, program.f @ _theta(run, k))
    yield claim(
        "8.4.1, (8.9)",
        "program",
        "cost and rows of (8.9), with the corrected Phi_3: largest difference of the "
        "optimum and of the least room to the limits, at a sample of 8.5.2",
        0.0,
        max(
            np.abs(printed - ours).max(),
            np.abs(best - np.linalg.solve(H, f)).max(),
        ),
        *EXACT,
        erratum="E8.5",
        note="the limits on outputs are taken as 0 and 2.5; the reference, through z, "
        "does not reach the outputs: the row c H_r of (8.9) is zero",
    )


def _missed_in_differences() -> float:
    y, u = _run("frozen").y[:, 0], _run("frozen").u[:, 0]
    k = np.arange(2, len(y) - 1)
    told = y[k] + 0.7 * (y[k] - y[k - 1]) + u[k - 1] * (u[k] - u[k - 1])
    return float(np.abs(told - y[k + 1]).max())


def _printed_8_9(run: Run, k: int, limits: Limits) -> tuple[Array, Array, Array, Array]:
    """M and N of (8.9), and H and f of its cost, made as printed from scalars."""
    design = case_of(PRODUCT).designs["frozen"]
    Np, Nc = design.horizon.Np, design.horizon.Nc
    y, last = float(run.y[k, 0]), float(run.u[k - 1, 0])
    powers = 0.7 ** np.arange(Np)
    first = np.cumsum(powers) * last
    Phi = scipy.linalg.toeplitz(first, np.zeros(Nc))
    free = 0.7 * powers * y + first * last
    C4, one = np.tri(Nc), np.ones(Nc)
    u, du, out = (limits.of(name, 1) for name in ("u", "du", "y"))
    M = np.vstack([-C4, C4, -np.eye(Nc), np.eye(Nc), -Phi, Phi])
    N = np.concatenate(
        [
            -u[0] * one + last,
            u[1] * one - last,
            -du[0] * one,
            du[1] * one,
            -out[0] + free,
            out[1] - free,
        ]
    )
    H = design.Q * Phi.T @ Phi + design.R * np.eye(Nc)
    return M, N, H, design.Q * Phi.T @ (free - run.r[k, 0])


def _feasible() -> Iterator[Claim]:
    tight = dataclasses.replace(case_of(PRODUCT).designs["frozen"].limits, y=(0, 2.0))
    frozen = _shifted_misses(_product("frozen", limits=tight))
    yield claim(
        "8.3.2",
        "frozen plans may become infeasible",
        "a frozen plan may break limits at the next sample, without any disturbance; "
        "here y <= 2 added to 8.4's limits",
        True,
        bool((frozen > 1e-6).any()),
        note=f"at {int((frozen > 1e-6).sum())} samples, by up to {frozen.max():.2f} "
        "summed over the horizon; limits on inputs and rates alone are never broken",
    )
    free = _shifted_misses(_product("iterated", limits=tight))
    yield claim(
        "8.4.3",
        "feasible by convergence",
        "convergence alone makes the plan with a zero change appended feasible; "
        "samples at which it breaks y <= 2",
        0,
        int((free > 1e-6).sum()),
        because="the sample that the shift adds to the horizon was not looked at "
        f"before (by up to {free.max():.1e}); only the terminal condition covers it",
    )
    ended = _shifted_misses(_product("iterated", terminal="equality", limits=tight))
    yield claim(
        "8.4.3",
        "feasible with the terminal condition",
        "the same with Assumption C.2.1 as rest at the reference",
        0,
        int((ended > 1e-6).sum()),
        erratum="E8.10",
    )


def _shifted_misses(run: Run) -> Array:
    """Sum what each shifted plan breaks the output limits by, while r is 2."""
    controller = run.controller
    assert isinstance(controller, StateDependentController)
    problem, missed = controller.problem, []
    for k in range(STEP + 1, len(run)):
        plan, theta = run.trail("u")[k - 1], _theta(run, k)
        plan = controller.kept_within(np.vstack([plan[1:], plan[-1:]]), theta)
        _, y = problem.rolled(problem.from_inputs(plan, theta), theta)
        beyond = np.abs(y) - controller.limits.of("y", 1)[1]
        missed.append(float(np.maximum(beyond, 0.0).sum()))
    return np.array(missed)


def _terminal() -> Iterator[Claim]:
    model, held = model_of(PRODUCT), 0.7
    before = ((2.0 - held**2) / 0.7 - held**2) / 0.7
    y0, u = np.array([[before]]), np.array([[held]])
    y = model.roll_out(y0, u, np.full((3, 1), held))[:, 0]
    yield claim(
        "8.4.3",
        "terminal condition, as printed",
        "an output at the set-point 2 at the end stays there under a zero change; "
        "here reached with u = 0.7 held",
        y[1],
        y[2],
        *EXACT,
        because="y = r is no rest unless the input that b depends on is sqrt(0.3 r); "
        "see E8.10",
    )
    run = _product("iterated", terminal="equality")
    plans = run.trail("u")[AFTER, -2:, 0]
    yield claim(
        "8.4.3",
        "terminal condition",
        "with rest as terminal condition every plan ends with sqrt(0.3 r) held; "
        "largest difference while r is 2",
        0.0,
        np.abs(plans - np.sqrt(0.6)).max(),
        1e-6,
        "accuracy of the solver",
        erratum="E8.10",
    )
    cost = run.cost[AFTER]
    yield claim(
        "8.4.3",
        "cost with the terminal condition",
        "with it the cost falls at every sample while r is 2",
        True,
        bool((np.diff(cost) <= 1e-9 * cost[0]).all()),
        erratum="E8.10",
        note=f"though the bound of the proof fails at "
        f"{len(_broken_promises(run))} samples",
    )


def _stability() -> Iterator[Claim]:
    yield claim(
        "8.3.3",
        "Assumptions 8.3.1 and 8.3.2",
        "every program has a solution, and the plan with its last input repeated is "
        "allowed at the next sample (limits on inputs and rates only)",
        True,
        bool((_run("integral_iterated").status < Status.SOFTENED).all())
        and _repeats_are_allowed(_run("integral_iterated")),
    )
    yield unchecked(
        "8.3.3",
        "Proposition 8.3.1",
        "under Assumptions 8.3.1 to 8.3.3 the loop is asymptotically stable",
        "no simulation decides stability for all starts, and in the only example the "
        "third assumption fails",
        note="the proof shows that the cost does not rise, about a point where it is "
        "not zero: neither suffices for asymptotic stability",
    )
    yield unchecked(
        "8.4.3",
        "Proposition 8.4.1",
        "under Assumptions C.2.1, C.2.2 and convergence the loop is asymptotically "
        "stable",
        "no simulation decides stability for all starts; the example has no terminal "
        "condition",
        note="its two steps do not hold as they stand: see the rows on the terminal "
        "condition and on the bound of the proof",
    )


def _repeats_are_allowed(run: Run) -> bool:
    controller = run.controller
    assert isinstance(controller, PredictiveController)
    low, high = controller.limits.of("u", 1)
    slow, fast = controller.limits.of("du", 1)
    plan = run.trail("u")[:-1, :, 0]
    ahead = np.hstack([plan[:, 1:], plan[:, -1:]])
    change = np.diff(np.hstack([run.u[:-1], ahead]), axis=1)[1:]
    inside = (ahead >= low - 1e-9) & (ahead <= high + 1e-9)
    return bool(
        inside.all() and (change >= slow - 1e-9).all() and (change <= fast + 1e-9).all()
    )


TOPICS = (
    *TOPICS_8_2,
    _frozen_8_3,
    *TOPICS_8_3,
    _predictions,
    _convergence,
    _optimality,
    *TOPICS_8_4,
    _increments_8_4,
    _feasible,
    _terminal,
    _stability,
    _starts_8_5_2,
    _figures,
    _trails,
    _costs,
)
"""Topics in the order of the text."""
