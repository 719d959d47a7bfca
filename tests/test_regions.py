"""Regions: one affine solution each, refused outside, and no more than agreed."""

import dataclasses

import numpy as np
import pytest
from strategies import positive

from nmss_lab import qp
from nmss_lab.predict import Affine
from nmss_lab.qp import Cost, Limit, assemble, kkt_residual, kkt_residuals
from nmss_lab.regions import Regions, region

SAME = 1e-8
"""Two exact solutions of one well-conditioned program; 1e-12 is seen."""


def program(seed, n_z=5, n_theta=3, rows=9):
    """Return a random program with two-sided rows, some of them one-sided."""
    rng = np.random.default_rng(seed)
    target = Affine(np.eye(n_z), rng.standard_normal((n_z, n_theta)))
    # rows that theta hardly moves: some decision keeps them all
    gain, known = rng.standard_normal((rows, n_z)), rng.standard_normal((rows, n_theta))
    low, high = -0.2 - rng.random(rows), 0.2 + rng.random(rows)
    low[:2], high[2:4] = -np.inf, np.inf
    limit = Limit("u", Affine(gain, 0.02 * known), low, high, 1, np.arange(rows))
    return assemble([Cost(target, positive(rng, n_z))], [limit])


def vectors(seed, loops, size=1.0):
    """Return random known vectors."""
    return size * np.random.default_rng(1000 + seed).standard_normal((loops, 3))


@pytest.mark.parametrize("seed", range(40))
def test_region_gives_the_solution_of_the_program(seed):
    """Decision and multipliers, wherever it says that a vector is inside."""
    p, theta = program(seed), vectors(seed, 60)
    first = qp.solve(p, theta[0])
    near = np.vstack([theta, theta[0] + 0.01 * vectors(seed + 7, 40)])
    inside, z, multipliers = region(p, first.multipliers).answer(near)
    assert 0 in inside
    for i, *found in zip(inside, z, multipliers, strict=True):
        wanted = qp.solve(p, near[i])
        assert wanted.found
        assert found[0] == pytest.approx(wanted.decision, abs=SAME)
        assert found[1] == pytest.approx(wanted.multipliers, abs=SAME)


@pytest.mark.parametrize("seed", range(40))
def test_vector_outside_a_region_is_refused(seed):
    """Inside are exactly those with the active rows of the first."""
    p, theta = program(seed), vectors(seed, 200, 2.0)
    solutions = [qp.solve(p, each) for each in theta]
    assert all(s.found for s in solutions)
    active = np.array([np.sign(s.multipliers) for s in solutions])
    inside, _, _ = region(p, solutions[0].multipliers).answer(theta)
    wanted = np.flatnonzero((active == active[0]).all(axis=1))
    assert inside.tolist() == wanted.tolist()
    assert len(wanted) < 200


@pytest.mark.parametrize("seed", range(5))
def test_solution_that_is_not_one_is_refused(seed):
    """Where rounding might matter, every answer is judged as a solver's is."""
    p, theta = program(seed), vectors(seed, 60)
    sure = region(p, qp.solve(p, theta[0]).multipliers)
    assert 0.0 <= sure.error < 1e-12
    wary = dataclasses.replace(sure, error=np.inf)
    for one, other in zip(sure.answer(theta), wary.answer(theta), strict=True):
        assert np.array_equal(one, other)
    assert len(wary.answer(theta)[0]) > 0
    wrong = sure.solution.copy()
    wrong[: p.n_z] += 1e-6
    spoiled = dataclasses.replace(wary, solution=wrong)
    assert [len(part) for part in spoiled.answer(theta)] == [0, 0, 0]


def test_residuals_of_many_are_those_of_each():
    """Columns and single vectors, good answers and bad ones."""
    p, theta = program(3), vectors(3, 20)
    rng = np.random.default_rng(0)
    z, m = rng.standard_normal((20, 5)), rng.standard_normal((20, 9))
    z[0], m[0] = (s := qp.solve(p, theta[0])).decision, s.multipliers
    problems = [
        qp.Problem(p.H, p.f @ t, p.M, p.lower - p.offset @ t, p.upper - p.offset @ t)
        for t in theta
    ]
    columns = [np.column_stack([getattr(q, n) for q in problems]) for n in COLUMNS]
    all_ = qp.Problem(p.H, columns[0], p.M, *columns[1:])
    found = kkt_residuals(all_, z.T, m.T)
    single = [kkt_residual(*each) for each in zip(problems, z, m, strict=True)]
    assert found == pytest.approx(single, rel=1e-9, abs=1e-14)
    assert found[0] <= qp.ACCEPTED < found[1]


COLUMNS = "f", "lower", "upper"


def test_rows_that_depend_on_each_other_make_no_region():
    """Their multipliers are not unique."""
    signal = Affine(np.array([[1.0, 0.0], [2.0, 0.0]]), np.zeros((2, 1)))
    rows = Limit("u", signal, -np.ones(2), np.array([1.0, 2.0]), 2, np.array([0]))
    pull = Affine(np.eye(2), np.array([[-5.0], [0.0]]))
    p = assemble([Cost(pull, np.eye(2))], [rows])
    assert region(p, np.array([1.0, 1.0])) is None
    assert region(p, np.array([1.0, 0.0])) is not None


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_equality_is_held_whatever_the_sign_of_its_multiplier(side):
    """From either side, and when the solver's multiplier was zero."""
    row = Affine(np.array([[1.0, 0.5]]), np.array([[0.1]]))
    equal = Limit("e", row, np.ones(1), np.ones(1), 1, np.array([0]))
    pull = Affine(np.eye(2), np.array([[3.0], [0.0]]))
    p = assemble([Cost(pull, np.eye(2))], [equal])
    for held in (np.zeros(1), np.ones(1), -np.ones(1)):
        inside, z, multipliers = region(p, held).answer(np.array([[4.0 * side]]))
        wanted = qp.solve(p, np.array([4.0 * side]))
        assert inside.tolist() == [0]
        assert z[0] == pytest.approx(wanted.decision, abs=SAME)
        assert multipliers[0] == pytest.approx(wanted.multipliers, abs=SAME)
        assert np.sign(multipliers[0, 0]) == -side


class Asked:
    """A solver that counts what it is asked, and notes its own answers."""

    def __init__(self, p, theta):
        self.p, self.theta, self.numbers = p, theta, []
        self.z = np.full((len(theta), p.n_z), np.nan)
        self.multipliers = np.full((len(theta), len(p.labels)), np.nan)

    def __call__(self, i):
        """Solve one, as a controller would."""
        self.numbers.append(i)
        solution = qp.solve(self.p, self.theta[i])
        self.z[i], self.multipliers[i] = solution.decision, solution.multipliers
        return solution.multipliers if solution.found else None

    def all(self, regions):
        """Return decisions and multipliers of all vectors."""
        answered = []
        for numbers, z, multipliers in regions.answers(self.theta, self):
            self.z[numbers], self.multipliers[numbers] = z, multipliers
            answered += numbers.tolist()
        assert len(answered) == len(set(answered))
        assert set(answered) | set(self.numbers) == set(range(len(self.theta)))
        return self.z, self.multipliers


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("most", [2, 256])
def test_together_they_are_answered_as_each_alone(seed, most):
    """Sample after sample, with regions kept and regions that had to go."""
    p = program(seed)
    regions, asked = Regions(p, most), 0
    for sample in range(5):
        theta = vectors(10 * seed + sample, 50)
        solver = Asked(p, theta)
        z, multipliers = solver.all(regions)
        asked += len(solver.numbers)
        wanted = [qp.solve(p, each) for each in theta]
        assert z == pytest.approx(np.array([s.decision for s in wanted]), abs=SAME)
        lagrange = np.array([s.multipliers for s in wanted])
        assert multipliers == pytest.approx(lagrange, abs=SAME)
        assert len(regions) <= most
    assert asked < 200 if most == 256 else asked <= 250


def test_one_solution_answers_all_that_share_its_active_rows():
    """And the next sample asks no solver at all."""
    p = program(1)
    start = vectors(1, 1, 2.0)
    assert qp.solve(p, start[0]).active.any()
    theta = start + 1e-4 * vectors(2, 300)
    regions, solver = Regions(p), Asked(p, theta)
    solver.all(regions)
    assert solver.numbers == [0]
    again = Asked(p, theta + 1e-4)
    again.all(regions)
    assert again.numbers == []


def test_bound_is_honoured_while_solving_too():
    """Those that answered the fewest go first."""
    p = program(2)
    regions, sizes = Regions(p, 3), []
    crowd = vectors(5, 1, 2.0) + 1e-4 * vectors(6, 50)
    theta = np.vstack([crowd, vectors(4, 200, 2.0)])
    solver = Asked(p, theta)

    def solve(i):
        sizes.append(len(regions))
        return solver(i)

    for _ in regions.answers(theta, solve):
        sizes.append(len(regions))
    assert max(sizes) == 3
    assert len(solver.numbers) > 20
    later = Asked(p, crowd)
    later.all(regions)
    assert later.numbers == []


def test_what_cannot_be_solved_is_left_to_whoever_was_asked():
    """No answer is made up, and the others get theirs."""
    p, theta = program(4), vectors(4, 30)
    solver = Asked(p, theta)
    asked = []

    def fails_often(i):
        asked.append(i)
        return None if i % 3 == 0 else solver(i)

    answered = [
        n for numbers, _, _ in Regions(p).answers(theta, fails_often) for n in numbers
    ]
    assert 0 in asked
    assert 0 not in answered
    assert set(answered) | set(asked) == set(range(30))


def test_wrong_multipliers_teach_nothing():
    """A region that does not hold the vector it came from is not kept."""
    p, theta = program(4), vectors(4, 10)
    regions = Regions(p)
    nonsense = np.zeros(9)
    nonsense[4] = 1.0
    inside = region(p, nonsense).answer(theta)[0]
    outside = np.delete(theta, inside, axis=0)
    assert list(regions.answers(outside, lambda i: nonsense)) == []
    assert len(regions) == 0


def test_answer_does_not_depend_on_the_company():
    """To the last digit: a loop must not feel which others are there."""
    p, theta = program(6), vectors(6, 1) + 1e-3 * vectors(7, 97)
    known = region(p, qp.solve(p, theta[0]).multipliers)
    inside, z, multipliers = known.answer(theta)
    assert len(inside) > 50
    for i, *wanted in zip(inside, z, multipliers, strict=True):
        _, *alone = known.answer(theta[i : i + 1])
        assert np.array_equal(alone[0][0], wanted[0])
        assert np.array_equal(alone[1][0], wanted[1])
