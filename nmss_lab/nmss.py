"""Non-minimal state space forms and the memory from which their states are built.

A form is the pair (model along the horizon, recipe for its state).  Everything a
controller remembers is one vector, its memory: past outputs, inputs and disturbances,
the sum of the error, the outputs of an internal model, an observer's estimate.  What
happens to the memory in one sample is linear, so a recipe is a handful of matrices.
The same matrices run one loop, a thousand loops in lock step, and the analysis.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg

from nmss_lab.models import (
    Array,
    DifferenceModel,
    minimal_realisation,
    reachable_basis,
    sort_by_size,
)


class Layout:
    """Names for the parts of a vector.

    Examples
    --------
    >>> known = Layout(x=2, r=(3, 1))
    >>> known.size
    5
    >>> known["r"]
    slice(2, 5, None)
    >>> known.pack(x=[1.0, 2.0], r=[[5.0], [6.0], [7.0]])
    array([1., 2., 5., 6., 7.])
    """

    def __init__(self, **shapes: int | tuple[int, ...]) -> None:
        self.shapes: dict[str, tuple[int, ...]] = {}
        self._slices: dict[str, slice] = {}
        self.size = 0
        for name, shape in shapes.items():
            self.shapes[name] = shape if isinstance(shape, tuple) else (shape,)
            end = self.size + int(np.prod(self.shapes[name]))
            self._slices[name] = slice(self.size, end)
            self.size = end

    def __getitem__(self, name: str) -> slice:
        """Where the part ``name`` stands in the vector."""
        return self._slices[name]

    def __contains__(self, name: str) -> bool:
        """Whether there is a part of that name."""
        return name in self._slices

    def select(self, name: str) -> Array:
        """Matrix that picks the part ``name``, (rows of the part, size)."""
        picked: Array = np.eye(self.size)[self[name]]
        return picked

    def pack(self, **values: object) -> Array:
        """Vector (size,) with the given parts; parts that are not given are zero."""
        vector = np.zeros(self.size)
        for name, value in values.items():
            vector[self[name]] = np.asarray(value, dtype=float).ravel()
        return vector

    def read(self, vector: Array, name: str) -> Array:
        """Part ``name`` of a vector (..., size) in its own shape."""
        part: Array = vector[..., self[name]]
        return part.reshape(*vector.shape[:-1], *self.shapes[name])


@dataclass(frozen=True, eq=False)
class Recipe:
    """How a controller's memory m changes in a sample, and what state it gives.

    Parameters
    ----------
    layout : Layout
        Parts of the memory: "y" (y_k first), "u" (u_{k-1} first), "v", "r", and what
        the structure needs of "integral", "y_model", "u_model", "estimate".
    carry, enter : arrays (n_m, n_m), (n_m, n_y + n_v + n_y)
        On measuring: m <- carry m + enter [y_k; v_k; r_k].
    keep, store : arrays (n_m, n_m), (n_m, 2 n_u + n_y)
        On applying an input: m <- keep m + store [u_k; u seen by the internal model;
        governed reference].
    state : array (n_x, n_m)
        State x_k from the memory after measuring.
    forecast : array (n_y, n_m)
        One-step prediction of y_k from the memory before measuring: stands in for a
        measurement that is not finite.
    """

    layout: Layout
    carry: Array
    enter: Array
    keep: Array
    store: Array
    state: Array
    forecast: Array


@dataclass(frozen=True, eq=False)
class Form:
    r"""State space form of a model, with the recipe for its state.

    .. math:: x_{k+1} = A x_k + B \nu_k + D r_{k+1} + G \delta_k, \qquad y_k = C x_k

    where :math:`\nu` is the input (``drive = "u"``) or its change (``"du"``) and
    :math:`\delta_k = [\Delta v_{k-l_1}; \Delta v_{k-l_2}; \dots]` holds changes of
    measured disturbances at the given lags.

    Parameters
    ----------
    A, B, C, D, G : arrays (n_x, n_x), (n_x, n_u), (n_y, n_x), (n_x, n_y), (n_x, .)
    drive : "u" or "du"
    recipe : Recipe
    names : tuple of str
        What each state is, for instance ``"y1[k-1]"``.
    lags : tuple of int
        Lags of the changes in delta: 0, 1, ... when they are offsets of the
        prediction, -1 (the coming change) when past ones are in the state.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    G: Array
    drive: Literal["u", "du"]
    recipe: Recipe
    names: tuple[str, ...]
    lags: tuple[int, ...] = ()

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return self.C.shape[0]

    def fixed_poles(self) -> Array:
        """Poles that no feedback of this state moves, other than those at the origin.

        A common factor of A(z) and B(z) leaves one (section 7.4.1 has such a plant:
        rank 3 of 4 and a pole at 0.9).
        """
        reached = reachable_basis(self.A, self.B)
        rest = scipy.linalg.null_space(reached.T) if reached.size else np.eye(self.n_x)
        left = np.linalg.eigvals(rest.T @ self.A @ rest)
        return sort_by_size(left[np.abs(left) > 1e-6])

    def controllable_rank(self) -> int:
        """Dimension of the states that the input can reach."""
        return reachable_basis(self.A, self.B).shape[1]


def integral_of_error_form(model: DifferenceModel, governed: bool = False) -> Form:
    """Form of (3.1)-(3.3): past outputs, past inputs and the sum of the error.

    The state has n_y (na + 1) + n_u (nb - 1) entries.  With ``governed`` the sum takes
    the reference that a governor hands in, not the one that is measured.
    """
    plain, names = _past(model)
    n, p = plain["A"].shape[0], model.n_y
    A = np.block([[plain["A"], np.zeros((n, p))], [-plain["A"][:p], np.eye(p)]])
    B = np.vstack([plain["B"], -plain["B"][:p]])
    D = np.eye(n + p, p, k=-n)
    layout = _layout(model, integral=p, w=p if governed else 0)
    rows = [_rows(layout, "y", model.na), _rows(layout, "u", model.nb - 1)]
    state = np.vstack([*rows, layout.select("integral")])
    names = (*names, *(f"sum of error in {y}" for y in model.y_names))
    recipe = _recipe(model, layout, state, governed=governed)
    return Form(
        A, B, np.eye(p, n + p), D, np.zeros((n + p, 0)), "u", recipe, tuple(names)
    )


def past_form(model: DifferenceModel) -> Form:
    """Form of past outputs and inputs alone, as they are: (3.2) without the sum."""
    plain, names = _past(model)
    n, p = plain["A"].shape[0], model.n_y
    layout = _layout(model)
    rows = [_rows(layout, "y", model.na), _rows(layout, "u", model.nb - 1)]
    recipe = _recipe(model, layout, np.vstack(rows))
    none = np.zeros((n, 0))
    return Form(
        plain["A"], plain["B"], np.eye(p, n), np.zeros((n, p)), none, "u", recipe, names
    )


def differenced_form(
    model: DifferenceModel,
    internal_model: bool = False,
    disturbances: Literal["ignored", "direct", "augmented"] = "ignored",
) -> Form:
    """Form of (4.5): changes of past outputs and inputs, and the outputs themselves.

    Parameters
    ----------
    model : DifferenceModel
    internal_model : bool
        Take the changes of outputs from a simulated model in place of the plant
        (forward path, 6.2); the last n_y entries stay measured.
    disturbances : "ignored", "direct" (7.5) or "augmented" (7.3)
        What becomes of measured disturbances: left out, known offsets of the
        prediction, or changes held in the state.  The augmented form leaves out the
        present increment that the printed (7.2)-(7.4) count twice.
    """
    plain, names = _past(model)
    A, B, p = plain["A"], plain["B"], model.n_y
    names = tuple(f"change of {name}" for name in names)
    lags: tuple[int, ...] = ()
    G = np.zeros((A.shape[0], 0))
    if disturbances == "direct":
        G, lags = np.zeros((A.shape[0], model.ng * model.n_v)), tuple(range(model.ng))
        G[:p] = _side_by_side(model.g)
    if disturbances == "augmented":
        A, B, G, names = _augment(model, A, B, names)
        lags = (-1,)
    n = A.shape[0]
    A = np.block([[A, np.zeros((n, p))], [A[:p], np.eye(p)]])
    B, G = np.vstack([B, B[:p]]), np.vstack([G, G[:p]])
    layout = _layout(model, internal=internal_model)
    source = "y_model" if internal_model else "y"
    rows = [_changes(layout, source, model.na), _changes(layout, "u", model.nb - 1)]
    if disturbances == "augmented":
        rows.append(_changes(layout, "v", model.ng))
    state = np.vstack([*rows, _rows(layout, "y", 1)])
    recipe = _recipe(model, layout, state)
    C, D = np.eye(p, n + p, k=n), np.zeros((n + p, p))
    return Form(A, B, C, D, G, "du", recipe, (*names, *model.y_names), lags)


def incremental_pip_form(model: DifferenceModel, internal_model: bool = False) -> Form:
    """Form of the incremental PIP law (3.13): changes of the state of (3.2).

    Its last entries are the error r_k - y_k, the change of the sum of the error; no
    sum is kept, hence none can wind up.
    """
    base = integral_of_error_form(model)
    layout = _layout(model, internal=internal_model)
    source = "y_model" if internal_model else "y"
    rows = [_changes(layout, source, model.na), _changes(layout, "u", model.nb - 1)]
    error = layout.select("r") - _rows(layout, "y", 1)
    recipe = _recipe(model, layout, np.vstack([*rows, error]))
    names = tuple(f"change of {name}" for name in base.names)
    return Form(base.A, base.B, base.C, base.D, base.G, "du", recipe, names)


def minimal_form(
    model: DifferenceModel,
    observer: Literal["deadbeat", "kalman"] = "deadbeat",
    process_noise: float = 1.0,
    measurement_noise: float = 0.01,
) -> Form:
    """Minimal realisation of (4.5) with an observer, for comparison (5.1.3).

    Parameters
    ----------
    model : DifferenceModel
    observer : "deadbeat" or "kalman"
        All poles at the origin, or the steady-state Kalman filter in current
        form for white noise of the given variances on the input's change and on the
        measured outputs.
    process_noise, measurement_noise : float
        Variances for the Kalman filter.

    Raises
    ------
    ValueError
        If the observer is of another kind or a variance is not positive.
    """
    base = differenced_form(model)
    A, B, C = minimal_realisation(base.A, base.B, base.C)
    if observer == "kalman":
        if min(process_noise, measurement_noise) <= 0:
            raise ValueError(
                f"process_noise = {process_noise} and measurement_noise = "
                f"{measurement_noise} must be positive variances"
            )
        current = _kalman(A, B, C, process_noise, measurement_noise)
        return observed_form(model, A, B, C, current, A @ current)
    if observer != "deadbeat":
        raise ValueError(f'observer = "{observer}": expected "deadbeat" or "kalman"')
    return observed_form(model, A, B, C, np.zeros_like(C.T), _deadbeat(A, C))


def observed_form(
    model: DifferenceModel, A: Array, B: Array, C: Array, current: Array, next_: Array
) -> Form:
    r"""Form of any realisation driven by changes of the input, with an observer.

    .. math:: \hat x_{k|k} = \hat x_k + M (y_k - C \hat x_k), \qquad
              \hat x_{k+1} = A \hat x_k + B \Delta u_k + L (y_k - C \hat x_k)

    Parameters
    ----------
    model : DifferenceModel
        Gives the sizes and stands in for measurements that are not finite.
    A, B, C : arrays (n_x, n_x), (n_x, n_u), (n_y, n_x)
    current, next_ : arrays (n_x, n_y)
        M and L; M = 0 is the prediction form, L = A M the current form.
    """
    n = A.shape[0]
    layout = _layout(model, estimate=n)
    estimate = layout.select("estimate")
    error = _rows(layout, "y", 1) - C @ estimate
    recipe = _recipe(model, layout, estimate + current @ error)
    keep, store = recipe.keep.copy(), recipe.store.copy()
    last_u = _rows(layout, "u", 1)
    keep[layout["estimate"]] = A @ estimate + next_ @ error - B @ last_u
    store[layout["estimate"], : model.n_u] = B
    recipe = Recipe(
        layout,
        recipe.carry,
        recipe.enter,
        keep,
        store,
        recipe.state,
        recipe.forecast,
    )
    zeros = np.zeros((n, model.n_y))
    names = tuple(f"x{i + 1}" for i in range(n))
    return Form(A, B, C, zeros, np.zeros((n, 0)), "du", recipe, names)


def _deadbeat(A: Array, C: Array) -> Array:
    """Gain L (n_x, n_y) that makes A - L C nilpotent, for an observable pair.

    Luenberger's canonical form: with the columns q_i that only the last row of chain i
    sees, L maps C A^{nu_i - 1} q_i to A^{nu_i} q_i.  Placing distinct poles near the
    origin instead asks for nearly parallel eigenvectors, and for gains up to 1e4.
    """
    chains = _chains(A, C)
    ends = np.cumsum([len(chain) for chain in chains]) - 1
    seen_last = np.linalg.inv(np.vstack(chains))[:, ends]
    moved = np.column_stack(
        [
            np.linalg.matrix_power(A, len(chain) - 1) @ q
            for chain, q in zip(chains, seen_last.T, strict=True)
        ]
    )
    gain: Array = A @ moved @ np.linalg.inv(C @ moved)
    return gain


def _chains(A: Array, C: Array) -> list[Array]:
    """Rows c_i, c_i A, ... of each output i that are independent, (nu_i, n_x) each."""
    chains: list[list[Array]] = [[] for _ in C]
    following, growing = list(C), list(range(len(C)))
    basis = np.zeros((0, A.shape[0]))
    while growing:
        for i in tuple(growing):
            rest = following[i] / np.linalg.norm(following[i])
            rest = rest - basis.T @ (basis @ rest)
            size = np.linalg.norm(rest)
            if size < 1e-6:
                growing.remove(i)
                continue
            basis = np.vstack([basis, rest / size])
            chains[i].append(following[i])
            following[i] = following[i] @ A
    return [np.array(chain) for chain in chains]


def _kalman(A: Array, B: Array, C: Array, q: float, r: float) -> Array:
    """Gain M (n_x, n_y) of the steady-state Kalman filter in current form."""
    noise = r * np.eye(C.shape[0])
    # A trace of noise on every state keeps the Riccati equation solvable when the
    # realisation has modes at the origin that the input noise does not excite.
    drive = q * B @ B.T + 1e-9 * q * np.eye(A.shape[0])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, drive, noise)
    gain: Array = np.linalg.solve(C @ P @ C.T + noise, C @ P).T
    return gain


def _past(model: DifferenceModel) -> tuple[dict[str, Array], tuple[str, ...]]:
    """Build A and B of (4.3): past outputs and inputs move down by one sample."""
    if not isinstance(model, DifferenceModel):
        raise ValueError(
            f"model is a {type(model).__name__}, expected a DifferenceModel; for a "
            "state-dependent one take the functions that begin with sdp_"
        )
    p, q, na, nb = model.n_y, model.n_u, model.na, model.nb
    n_past_y, n_past_u = na * p, (nb - 1) * q
    A = np.zeros((n_past_y + n_past_u,) * 2)
    A[:p, :n_past_y] = -_side_by_side(model.a)
    A[:p, n_past_y:] = _side_by_side(model.b[1:])
    A[p:n_past_y, : n_past_y - p] = np.eye(n_past_y - p)
    B = np.zeros((A.shape[0], q))
    B[:p] = model.b[0]
    if nb > 1:
        A[n_past_y + q :, n_past_y:-q] = np.eye(n_past_u - q)
        B[n_past_y : n_past_y + q] = np.eye(q)
    names = [f"{y}[{_at(i)}]" for i in range(na) for y in model.y_names]
    names += [f"{u}[{_at(i + 1)}]" for i in range(nb - 1) for u in model.u_names]
    return {"A": A, "B": B}, tuple(names)


def _augment(
    model: DifferenceModel, A: Array, B: Array, names: tuple[str, ...]
) -> tuple[Array, Array, Array, tuple[str, ...]]:
    """Add changes of disturbances to the state (7.2); G takes the next increment."""
    n, width, r = A.shape[0], model.ng * model.n_v, model.n_v
    wide = np.zeros((n + width, n + width))
    wide[:n, :n] = A
    wide[: model.n_y, n:] = _side_by_side(model.g)
    wide[n:, n:] = np.eye(width, k=-r)
    G = np.eye(n + width, r, k=-n)
    added = [f"change of {v}[{_at(i)}]" for i in range(model.ng) for v in model.v_names]
    return wide, np.vstack([B, np.zeros((width, B.shape[1]))]), G, (*names, *added)


def _layout(model: DifferenceModel, internal: bool = False, **more: int) -> Layout:
    """Memory of the histories that every structure keeps, and ``more`` parts."""
    shapes: dict[str, int | tuple[int, ...]] = {
        "y": (model.na + 1, model.n_y),
        "u": (model.nb + 1, model.n_u),
        "v": (model.ng + 1, model.n_v),
        "r": model.n_y,
    }
    if internal:
        shapes["y_model"] = (model.na + 1, model.n_y)
        shapes["u_model"] = (model.nb, model.n_u)
    return Layout(**shapes, **{name: size for name, size in more.items() if size})


def _recipe(
    model: DifferenceModel, layout: Layout, state: Array, governed: bool = False
) -> Recipe:
    p, q, r = model.n_y, model.n_u, model.n_v
    carry, keep = np.eye(layout.size), np.eye(layout.size)
    enter, store = (
        np.zeros((layout.size, 2 * p + r)),
        np.zeros((layout.size, 2 * q + p)),
    )
    _push(layout, "y", carry, enter, slice(0, p))
    _push(layout, "v", carry, enter, slice(p, p + r))
    _push(layout, "r", carry, enter, slice(p + r, None))
    _push(layout, "u", keep, store, slice(0, q))
    forecast = _one_step_of_changes(model, layout)
    if "integral" in layout:
        enter[layout["integral"], :p] = -np.eye(p)
        if governed:
            store[layout["integral"], 2 * q :] = np.eye(p)
            _push(layout, "w", keep, store, slice(2 * q, None))
        else:
            enter[layout["integral"], p + r :] = np.eye(p)
    if "y_model" in layout:
        _push(layout, "y_model", carry, enter, None)
        newest = layout["y_model"].start
        simulated = _one_step(model, layout, "y_model", "u_model")
        simulated[:, layout["v"]] = 0.0  # the prediction does not see v either
        carry[newest : newest + p] = simulated
        _push(layout, "u_model", keep, store, slice(q, 2 * q))
    return Recipe(layout, carry, enter, keep, store, state, forecast)


def _push(
    layout: Layout, name: str, move: Array, take: Array, columns: slice | None
) -> None:
    """Let the part ``name`` forget its oldest row and take in a new first one."""
    part, width = layout[name], layout.shapes[name][-1]
    size = part.stop - part.start
    move[part, part] = np.eye(size, k=-width)
    if columns is not None:
        take[part.start : part.start + width, columns] = np.eye(width)


def _one_step(model: DifferenceModel, layout: Layout, y: str, u: str) -> Array:
    """y_k predicted by (2.1) from histories that end at sample k - 1."""
    row = np.zeros((model.n_y, layout.size))
    for name, coefficients in ((y, -model.a), (u, model.b), ("v", model.g)):
        start = layout[name].start
        stacked = _side_by_side(coefficients)
        row[:, start : start + stacked.shape[1]] = stacked
    return row


def _one_step_of_changes(model: DifferenceModel, layout: Layout) -> Array:
    """y_{k-1} and the change that (4.1) predicts: right under any constant load."""
    change = -_side_by_side(model.a) @ _changes(layout, "y", model.na)
    change += _side_by_side(model.b) @ _changes(layout, "u", model.nb)
    change += _side_by_side(model.g) @ _changes(layout, "v", model.ng)
    return _rows(layout, "y", 1) + change


def _rows(layout: Layout, name: str, count: int) -> Array:
    """First ``count`` samples of a history."""
    rows: Array = layout.select(name)[: count * layout.shapes[name][-1]]
    return rows


def _changes(layout: Layout, name: str, count: int) -> Array:
    """First ``count`` changes, sample minus the one before, of a history."""
    rows, width = layout.select(name), layout.shapes[name][-1]
    changes: Array = rows[: count * width] - rows[width : (count + 1) * width]
    return changes


def _side_by_side(blocks: Array) -> Array:
    """Stack (n, rows, columns) into (rows, n columns)."""
    n, rows, columns = blocks.shape
    return blocks.transpose(1, 0, 2).reshape(rows, n * columns)


def _at(lag: int) -> str:
    return f"k-{lag}" if lag else "k"
