"""Plants whose coefficients depend on past outputs and inputs (thesis 8.1).

A state-dependent parameter (SDP) model is the difference equation of ``models`` with
coefficients that are functions of what has been measured.  Frozen at a sample it is a
``DifferenceModel``; along a trajectory it is one that changes from step to step.
All functions are evaluated for many samples, plans or loops at once, over any leading
axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.optimize

from nmss_lab.expressions import Expression
from nmss_lab.models import Array, DifferenceModel, Numbers

Parameter = float | str | Callable[[Array, Array], Array]
"""A coefficient: a number, a text such as ``"0.3*y[k-1]"``, or a function of past
outputs (..., lags, n_y) and inputs (..., lags, n_u), the most recent first, that
returns (...); it must accept complex numbers where derivatives are taken."""

TINY = 1e-30
"""Step of the complex-step derivative: nothing is subtracted, so it may be tiny."""


@dataclass(frozen=True, eq=False)
class StateDependentModel:
    r"""Difference equation with coefficients that depend on past values, (8.1).

    .. math:: y_k + \sum_{i=1}^{n_a} a_i(\chi_k) y_{k-i}
              = \sum_{i=1}^{n_b} b_i(\psi_k) u_{k-i}

    where :math:`\chi_k` and :math:`\psi_k` are outputs and inputs up to sample k-1.

    Parameters
    ----------
    a, b : nested sequences (na, n_y, n_y), (nb, n_y, n_u) of Parameter
        Plain lists describe a single-input single-output model.  In texts ``y[k-2]``
        is the output two samples before the one that the equation gives; with several
        outputs they are ``y1``, ``y2``, ..., or go by their names.
    dt : float
        Sampling interval in seconds.
    y_names, u_names : sequences of str, optional
    units : mapping from a signal's name to its unit, optional
    constants : mapping from a name to a number, optional
        Numbers that texts may use by name.
    y_lags, u_lags : int
        How many past outputs and inputs coefficients read, where they are functions;
        texts say so themselves.

    Raises
    ------
    ValueError
        If a shape does not fit, a text cannot be read, or dt <= 0.

    Examples
    --------
    The bilinear plant (8.11), y_k = 0.7 y_{k-1} + y_{k-2} u_{k-1}:

    >>> model = StateDependentModel([-0.7], ["y[k-2]"])
    >>> model.y_lags, model.u_lags
    (2, 1)
    >>> model.frozen(np.array([[2.0], [1.5]]), np.array([[0.0]])).b.ravel()
    array([1.5])
    """

    a: Any
    b: Any
    dt: float = 1.0
    y_names: Sequence[str] = ()
    u_names: Sequence[str] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    constants: Mapping[str, float] = field(default_factory=dict)
    y_lags: int = 0
    u_lags: int = 0

    def __post_init__(self) -> None:
        """Check the shapes, read the texts, and count the lags."""
        a, b = _table("a", self.a), _table("b", self.b)
        n_y = a.shape[1]
        if a.shape[2] != n_y or b.shape[1] != n_y:
            raise ValueError(
                f"a has shape {a.shape}, b {b.shape}: expected (na, n_y, n_y) and "
                "(nb, n_y, n_u)"
            )
        set_ = object.__setattr__
        # the names, units and interval are checked by the model frozen at zero
        still = DifferenceModel(
            np.zeros(a.shape),
            np.zeros(b.shape),
            dt=self.dt,
            y_names=self.y_names,
            u_names=self.u_names,
            units=self.units,
        )
        for key in ("y_names", "u_names", "units"):
            set_(self, key, getattr(still, key))
        set_(self, "constants", dict(self.constants))
        parsed = {"a": self._read("a", a), "b": self._read("b", b)}
        set_(self, "_parsed", parsed)
        entries = [entry for table in parsed.values() for entry in table.flat]
        texts = [entry for entry in entries if isinstance(entry, Expression)]
        for key, least in (("y_lags", len(a)), ("u_lags", len(b))):
            deepest = max((getattr(text, key) for text in texts), default=0)
            set_(self, key, max(least, deepest, getattr(self, key)))
        set_(self, "a", _nested(a))
        set_(self, "b", _nested(b))

    def _read(self, name: str, table: Array) -> Array:
        """Table of numbers, expressions and functions."""
        read = np.empty(table.shape, dtype=object)
        for where in np.ndindex(table.shape):
            entry = table[where]
            label = f"{name}[{', '.join(map(str, where))}]"
            if isinstance(entry, str):
                read[where] = self._expression(label, entry)
            elif callable(entry):
                read[where] = entry
            else:
                read[where] = _number(label, entry)
        return read

    def _expression(self, label: str, text: str) -> Expression | float:
        try:
            found = Expression(
                text, tuple(self.y_names), tuple(self.u_names), self.constants
            )
        except ValueError as error:
            raise ValueError(f"{label} {error}") from error
        if found.y_lags or found.u_lags:
            return found
        nothing = np.zeros((1, self.n_y)), np.zeros((1, self.n_u))
        return _number(label, found(*nothing))

    @property
    def na(self) -> int:
        """Number of coefficients on past outputs."""
        return len(self.a)

    @property
    def nb(self) -> int:
        """Number of coefficients on past inputs."""
        return len(self.b)

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return len(self.y_names)

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return len(self.u_names)

    @property
    def n_v(self) -> int:
        """Number of measured disturbances: none."""
        return 0

    @cached_property
    def varying(self) -> list[tuple[str, tuple[int, ...], Callable[..., Array]]]:
        """Coefficients that are not constant: which table, where, and the function."""
        tables = self._parsed  # type: ignore[attr-defined]
        return [
            (name, where, table[where])
            for name, table in tables.items()
            for where in np.ndindex(table.shape)
            if callable(table[where])
        ]

    @cached_property
    def _row_parts(self) -> tuple[Array, list[tuple[Any, str, Any]]]:
        """Rows [a b] (n_y, na n_y + nb n_u): the constants, and what is put in."""
        constant = np.zeros((self.n_y, self.na * self.n_y + self.nb * self.n_u))
        varying: list[tuple[Any, str, Any]] = []
        for name, table in self._parsed.items():  # type: ignore[attr-defined]
            begin = 0 if name == "a" else self.na * self.n_y
            for (lag, i, j), entry in np.ndenumerate(table):
                column = begin + lag * table.shape[2] + j
                if callable(entry):
                    label = f"{name}{[lag, i, j]}"
                    varying.append(((..., i, column), label, entry))
                else:
                    constant[i, column] = entry
        return constant, varying

    @cached_property
    def wide(self) -> DifferenceModel:
        """Model of the same signals that remembers all that coefficients read.

        Its coefficients are zero: it gives sizes and names.
        """
        return self.model_of(
            np.zeros((self.y_lags, self.n_y, self.n_y)),
            np.zeros((self.u_lags, self.n_y, self.n_u)),
        )

    def model_of(self, a: Array, b: Array) -> DifferenceModel:
        """Model of the same signals with the coefficients given."""
        return DifferenceModel(
            a,
            b,
            dt=self.dt,
            y_names=self.y_names,
            u_names=self.u_names,
            units=self.units,
        )

    def coefficients(self, y: Array, u: Array) -> tuple[Array, Array]:
        """Coefficients of the equation that gives y_k from past values.

        Parameters
        ----------
        y, u : arrays (..., y_lags, n_y), (..., u_lags, n_u)
            y_{k-1}, y_{k-2}, ... and u_{k-1}, u_{k-2}, ...

        Returns
        -------
        a, b : arrays (..., na, n_y, n_y), (..., nb, n_y, n_u)
            Not finite where a function is not.

        Raises
        ------
        ValueError
            If there are not as many past values as coefficients read.
        """
        for name, past, lags, size in (
            ("y", y, self.y_lags, self.n_y),
            ("u", u, self.u_lags, self.n_u),
        ):
            if past.ndim < 2 or past.shape[-2] < lags or past.shape[-1] != size:
                raise ValueError(
                    f"{name} has shape {past.shape}, expected (..., {lags}, {size})"
                )
        with np.errstate(all="ignore"):
            return self._split_rows(self._rows(y, u), self.na, self.nb)

    def _rows(self, y: Array, u: Array) -> Array:
        """Rows [a b] (..., n_y, na n_y + nb n_u), see ``coefficients``."""
        constant, varying = self._row_parts
        kind = complex if "c" in (y.dtype.kind, u.dtype.kind) else float
        rows = np.empty((*y.shape[:-2], *constant.shape), dtype=kind)
        rows[...] = constant
        for where, label, entry in varying:
            value = getattr(entry, "bare", entry)(y, u)
            if not isinstance(entry, Expression):
                _check_value(label, value, y.shape[:-2])
            rows[where] = value
        return rows

    def _split_rows(self, rows: Array, na: int, nb: int) -> tuple[Array, Array]:
        """Coefficients a (..., na, n_y, n_y), b (..., nb, n_y, n_u) from [a b]."""
        n, lead = na * self.n_y, rows.shape[:-1]
        a = rows[..., :n].reshape(*lead, na, self.n_y)
        b = rows[..., n:].reshape(*lead, nb, self.n_u)
        return a.swapaxes(-2, -3), b.swapaxes(-2, -3)

    def step(self, y: Array, u: Array) -> Array:
        """Output y_k (..., n_y) that follows past values, see ``coefficients``."""
        past = _flat(-y[..., : self.na, :], u[..., : self.nb, :])
        following: Array = (self._rows(y, u) @ past[..., None])[..., 0]
        return following

    def frozen(self, y: Array, u: Array) -> DifferenceModel:
        """Model with the coefficients at past values (y_lags, n_y), (u_lags, n_u).

        Raises
        ------
        ValueError
            If a coefficient is not finite there.
        """
        return self.model_of(*self.coefficients(y, u))

    def roll_out(
        self, y: Array, u: Array, ahead: Array, load: Array | float = 0.0
    ) -> Array:
        """Simulate y_{k+1} ... y_{k+N} under inputs u_k ... u_{k+N-1}.

        Parameters
        ----------
        y, u : arrays (..., y_lags, n_y), (..., u_lags - 1 or more, n_u)
            y_k, y_{k-1}, ... and u_{k-1}, u_{k-2}, ...
        ahead : array (..., N, n_u)
        load : array (n_y,), optional
            Constant added to the right-hand side.

        Returns
        -------
        array (..., N, n_y)
            Grows without bound, to infinity or to nan, where the plant does.
        """
        lags, steps = self.y_lags, ahead.shape[-2]
        inputs = self._inputs(u, ahead)[..., ::-1, :]  # the last one first
        outputs = np.empty(
            (*ahead.shape[:-2], steps + lags, self.n_y), np.result_type(y, u, ahead)
        )
        outputs[..., steps:, :] = y[..., :lags, :]
        with np.errstate(all="ignore"):  # what runs away is told by its size
            for i in reversed(range(steps)):
                past_y = outputs[..., i + 1 : i + 1 + lags, :]
                past_u = inputs[..., i : i + self.u_lags, :]
                outputs[..., i, :] = self.step(past_y, past_u) + load
        return outputs[..., :steps, :][..., ::-1, :]

    def windows(
        self, y: Array, u: Array, outputs: Array, ahead: Array
    ) -> tuple[Array, Array]:
        """Past values that each step of a trajectory reads.

        Parameters
        ----------
        y, u, ahead : see ``roll_out``
        outputs : array (N, n_y)
            What ``roll_out`` gave.

        Returns
        -------
        arrays (N, y_lags, n_y), (N, u_lags, n_u)
            The windows of y_{k+1}, y_{k+2}, ...
        """
        before = np.concatenate([y[: self.y_lags][::-1], outputs[:-1]])
        return _windows(before, self.y_lags), _windows(
            self._inputs(u, ahead), self.u_lags
        )

    def _inputs(self, u: Array, ahead: Array) -> Array:
        """Put inputs in the order of time, those before sample k first."""
        before = u[..., : self.u_lags - 1, :][..., ::-1, :]
        if before.ndim < ahead.ndim:  # one past for many runs
            before = np.broadcast_to(before, (*ahead.shape[:-2], *before.shape[-2:]))
        return np.concatenate([before, ahead], axis=-2)

    def derivative(self, y: Array, u: Array) -> tuple[Array, Array]:
        """Differentiate ``step``, in the form of coefficients.

        Found by the complex step, exact to rounding: functions must accept complex
        numbers.

        Returns
        -------
        a, b : arrays (..., y_lags, n_y, n_y), (..., u_lags, n_y, n_u)
            ``-a`` and ``b`` are the derivatives by past outputs and inputs.
        """
        slopes = self._complex_slopes(y, u)
        if self._doubtful:
            self._check_slopes(y, u, slopes)
        by_y, by_u = self._split_rows(slopes, self.y_lags, self.u_lags)
        return -by_y, by_u

    def curvature(self, y: Array, u: Array) -> Array:
        """Second derivatives of ``step``, (..., n_y, m, m).

        m = y_lags n_y + u_lags n_u past values, outputs first, the most recent first.
        Central differences of exact first derivatives: good to about 1e-9.
        """
        flat = _flat(y, u)
        size = 6e-6 * (1.0 + np.abs(flat))
        columns = []
        for j in range(flat.shape[-1]):
            change = np.zeros_like(flat)
            change[..., j] = size[..., j]
            ends = np.stack([flat + change, flat - change])
            above, below = self._complex_slopes(*self._split(ends))
            columns.append((above - below) / (2.0 * size[..., None, j : j + 1]))
        hessian = np.stack(columns, axis=-1)
        symmetric: Array = (hessian + np.swapaxes(hessian, -1, -2)) / 2.0
        return symmetric

    @cached_property
    def _doubtful(self) -> bool:
        """Whether a coefficient is a function that may not accept complex numbers."""
        return any(not isinstance(f, Expression) for _, _, f in self.varying)

    def _check_slopes(self, y: Array, u: Array, slopes: Array) -> None:
        """Compare with differences; a function may drop the imaginary part.

        Raises
        ------
        ValueError
            If they disagree.
        """
        flat = _flat(y, u)
        step = 1e-6 * (1.0 + np.abs(flat))
        for j in range(flat.shape[-1]):
            change = np.zeros_like(flat)
            change[..., j] = step[..., j]
            ends = (self.step(*self._split(flat + s * change)) for s in (1, -1))
            above, below = ends
            slope = (above - below) / (2.0 * step[..., j : j + 1])
            apart = np.abs(slope - slopes[..., j])
            if (apart > 1e-3 * (1.0 + np.abs(slope))).any():
                raise ValueError(
                    "a coefficient is a function whose derivative cannot be taken by a "
                    "complex step: it drops the imaginary part, as abs and comparisons "
                    "do, or has a kink here; write it as a text, or without them"
                )

    def _complex_slopes(self, y: Array, u: Array) -> Array:
        """Differentiate all past values, (..., n_y, m)."""
        flat = _flat(y, u)
        m = flat.shape[-1]
        moved = flat[None] + 1j * TINY * np.eye(m).reshape(
            m, *(1,) * (flat.ndim - 1), m
        )
        with np.errstate(all="ignore"):
            try:
                slopes = self.step(*self._split(moved)).imag / TINY
            except TypeError as error:
                raise ValueError(
                    f"a coefficient is a function that does not accept complex numbers "
                    f"({error}), which derivatives need; write it as a text"
                ) from error
        return np.moveaxis(slopes, 0, -1)

    def _split(self, flat: Array) -> tuple[Array, Array]:
        n = self.y_lags * self.n_y
        lead = flat.shape[:-1]
        return (
            flat[..., :n].reshape(*lead, self.y_lags, self.n_y),
            flat[..., n:].reshape(*lead, self.u_lags, self.n_u),
        )

    def simulate(self, u: Array, y0: Numbers = 0.0, u0: Numbers = 0.0) -> Array:
        """Simulate y (N, n_y) for inputs u (N, n_u); y[k] does not depend on u[k].

        Before the first sample the output is ``y0`` and the input ``u0``; an input
        (..., N, n_u) gives many runs at once.
        """
        u = np.asarray(u, dtype=float)
        u = u[:, None] if u.ndim == 1 else u
        if u.ndim < 2 or u.shape[-1] != self.n_u or not u.shape[-2]:
            raise ValueError(f"u has shape {u.shape}, expected (..., N, {self.n_u})")
        y, past = self._constant_past(y0, u0)
        lead = u.shape[:-2]
        y = np.broadcast_to(y, (*lead, *y.shape))
        ahead = self.roll_out(y, past, u[..., :-1, :])
        return np.concatenate([y[..., :1, :], ahead], axis=-2)

    def _constant_past(self, y0: Numbers, u0: Numbers) -> tuple[Array, Array]:
        past = []
        for name, value, lags, size in (
            ("y0", y0, self.y_lags, self.n_y),
            ("u0", u0, self.u_lags, self.n_u),
        ):
            start = np.asarray(value, dtype=float)
            if start.shape not in ((), (1,), (size,)):
                raise ValueError(f"{name} has shape {start.shape}, expected ({size},)")
            past.append(np.broadcast_to(start, (lags, size)))
        return past[0], past[1]

    def rest(self, u0: Numbers, near: Numbers = 1.0) -> Array:
        """Output (n_y,) at rest under a constant input; there may be several.

        Parameters
        ----------
        u0 : array (n_u,)
        near : array (n_y,)
            Where to look first.

        Raises
        ------
        ValueError
            If none is found from there.
        """

        def drift(y0: Array) -> Array:
            return self.step(*self._constant_past(y0, u0)) - y0

        start = np.broadcast_to(np.asarray(near, float), (self.n_y,))
        with np.errstate(all="ignore"):
            found = scipy.optimize.root(drift, start, tol=1e-13)
            left = np.abs(drift(found.x)).max()
        if not left <= 1e-9 * (1.0 + np.abs(found.x).max()):
            raise ValueError(
                f"u0 = {u0} gives no rest near y = {start}: name a y0, or look "
                "elsewhere"
            )
        rest: Array = found.x
        return rest

    def plant(self) -> StateDependentPlant:
        """Plant that obeys this equation."""
        return StateDependentPlant(self)


@dataclass(frozen=True, eq=False)
class StateDependentPlant:
    """A state-dependent model as a plant; its state is its past.

    ``load`` (n_y,) is added to the equation at each sample: a plant that the model
    does not quite describe.
    """

    model: StateDependentModel
    load: Numbers = 0.0

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return self.model.n_y

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return self.model.n_u

    @property
    def n_v(self) -> int:
        """Number of measured disturbances: none."""
        return 0

    @property
    def dt(self) -> float:
        """Sampling interval in seconds."""
        return self.model.dt

    def reset(
        self, u0: Array, v0: Array, y0: Array | None = None
    ) -> tuple[Array, Array]:
        """Past in which input and output were constant.

        Raises
        ------
        ValueError
            If no y0 is given and u0 gives no rest.
        """
        y0 = self.model.rest(u0) if y0 is None else y0
        y, u = self.model._constant_past(y0, u0)
        return y.copy(), u.copy()

    def output(self, state: tuple[Array, Array]) -> Array:
        """Return the outputs y_k (..., n_y)."""
        y, _ = state
        newest: Array = y[..., 0, :]
        return newest

    def step(self, state: tuple[Array, Array], u: Array, v: Array) -> Any:
        """Past one sample later."""
        y, past = state
        inputs = np.concatenate([u[..., None, :], past[..., :-1, :]], axis=-2)
        with np.errstate(all="ignore"):  # the loop looks whether it is finite
            following = self.model.step(y, inputs) + self.load
        return np.concatenate([following[..., None, :], y[..., :-1, :]], -2), inputs


def _table(name: str, value: Any) -> Array:
    """Coefficients as a table (order, rows, columns) of numbers, texts, functions."""
    if isinstance(value, str) or callable(value):
        raise ValueError(
            f"{name} = {value!r}: expected a list of coefficients, one a lag"
        )
    shape = tuple(_lengths(name, value))
    table = np.empty(shape, dtype=object)
    for where in np.ndindex(shape):
        entry = value
        for i in where:
            entry = entry[i]
        table[where] = entry
    if table.ndim == 1:
        table = table[:, None, None]
    if table.ndim != 3 or table.shape[0] == 0:
        raise ValueError(
            f"{name} has shape {shape}, expected (order, rows, columns) with an order "
            "of at least 1, or a plain list for a single input and output"
        )
    return table


def _lengths(name: str, value: Any) -> Iterator[int]:
    """Lengths of the levels of a regular nest of sequences."""
    level = [value]
    while all(isinstance(entry, Sequence | np.ndarray) for entry in level) and not any(
        isinstance(entry, str) for entry in level
    ):
        sizes = {len(entry) for entry in level}
        if len(sizes) != 1:
            raise ValueError(f"{name} is not regular: rows of {sorted(sizes)} entries")
        yield sizes.pop()
        level = [inner for entry in level for inner in entry]
        if not level:
            return


def _check_value(label: str, value: Any, lead: tuple[int, ...]) -> None:
    """Check that a function has kept the leading axes of what it was given."""
    if np.shape(value) not in ((), lead):
        raise ValueError(
            f"{label} returned shape {np.shape(value)}, expected {lead}: past values "
            "come as (..., lags, channels), so write y[..., 0, 0] for y[k-1]"
        )


def _nested(table: Array) -> tuple[Any, ...]:
    """Nested tuples, which a file can hold as long as they hold no function."""
    return tuple(tuple(tuple(row) for row in matrix) for matrix in table.tolist())


def _number(label: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{label} = {value!r}: expected a number, a text or a function"
        ) from error
    if not np.isfinite(number):
        raise ValueError(f"{label} = {number} is not finite")
    return number


def _windows(series: Array, lags: int) -> Array:
    """Windows (N, lags, channels), the newest value first."""
    first = np.arange(lags - 1, len(series))[:, None]
    windows: Array = series[first - np.arange(lags)]
    return windows


def _flat(y: Array, u: Array) -> Array:
    lead = y.shape[:-2]
    return np.concatenate([y.reshape(*lead, -1), u.reshape(*lead, -1)], axis=-1)
