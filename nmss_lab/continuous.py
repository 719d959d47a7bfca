"""Continuous-time plants and their exact sampling.

Inputs and measured disturbances are held constant over a sampling interval.  For such
inputs a linear plant with any dead times, whole or fractional samples, has an exact
description at the sampling times and between them; `ContinuousPlant` computes it as a
`LinearPlant` (for simulation) and as a `DifferenceModel` (for control design).

Channels of one output with equal denominators share one state-space block, so that an
integrator common to two inputs is one state and not two that drift apart.  A block
sees input j through pairs (lag, effect): a dead time of 2.3 samples means that the
input of three samples ago acts for 0.3 of the interval and the one of two samples ago
for the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg

from nmss_lab.models import (
    Array,
    Between,
    DifferenceModel,
    LinearPlant,
    reachable_basis,
    sort_by_size,
)

# Dead times this close to a whole number of samples, in samples, are taken as whole.
WHOLE = 1e-9
# How sharply to look for common factors; the first reduction that passes is taken.
REDUCTIONS = (1e-8, 1e-10, 1e-12)
# A reduction passes if it changes no impulse response by more than this share of it.
UNCHANGED = 1e-12
# Sums this small against their terms are rounding, and coefficients are set to zero.
NEGLIGIBLE = 2e-15

NO_FEEDTHROUGH = (
    "the difference equation (2.1) has no u_k on its right-hand side, "
    "since y_k is measured before u_k is computed"
)


@dataclass(frozen=True)
class TransferFunction:
    r"""A strictly proper transfer function in continuous time with a dead time.

    .. math:: G(s) = \frac{b_0 s^m + \dots + b_m}{a_0 s^n + \dots + a_n} e^{-\tau s},
              \qquad m < n

    Parameters
    ----------
    num, den : sequences of float
        Coefficients of descending powers of s.
    delay : float
        Dead time in seconds, or whatever unit of time num and den are in; not negative.

    Raises
    ------
    ValueError
        If a coefficient is not finite, if num or den is zero, if the fraction is not
        strictly proper, or if the delay is negative.

    Examples
    --------
    One pathway of the Shell fractionator (Table 5.1):

    >>> channel = TransferFunction([6.9], [40.0, 1.0], delay=15.0)
    >>> channel.steady_state_gain(), channel.poles()
    (6.9, array([-0.025+0.j]))
    """

    num: Sequence[float]
    den: Sequence[float]
    delay: float = 0.0

    def __post_init__(self) -> None:
        num, den = _polynomial("num", self.num), _polynomial("den", self.den)
        if len(num) >= len(den):
            raise ValueError(
                f"num has degree {len(num) - 1} and den degree {len(den) - 1}; "
                f"expected a smaller degree in num (no feedthrough): {NO_FEEDTHROUGH}"
            )
        if not (np.isfinite(self.delay) and self.delay >= 0):
            raise ValueError(f"delay is {self.delay}; expected a number of at least 0")
        for name, value in (("num", num), ("den", den), ("delay", float(self.delay))):
            object.__setattr__(self, name, value)

    def steady_state_gain(self) -> float:
        """Gain G(0), infinite for an integrator."""
        return self.num[-1] / self.den[-1] if self.den[-1] else np.inf

    def poles(self) -> Array:
        """Roots of the denominator, the largest first, complex (n,)."""
        return sort_by_size(np.roots(self.den).astype(complex))


Channel: TypeAlias = TransferFunction | None
Channels: TypeAlias = Sequence[Sequence[Channel]]


class _Effect(NamedTuple):
    """What an input of ``lag`` samples ago adds to the state of a block, (n,)."""

    column: int
    lag: int
    gain: Array


class _Sampled(NamedTuple):
    """A block over one span of time: free motion, effects of the held inputs."""

    A: Array
    c: Array
    effects: list[_Effect]


class _Block(NamedTuple):
    """Channels of one output with one denominator: x' = A x + sum B_j w_j(t - delay_j).

    Column j of B belongs to the input (or disturbance) number ``columns[j]``.
    """

    A: Array
    B: Array
    c: Array
    columns: list[int]
    delays: list[float]

    def over(self, span: float, dt: float) -> _Sampled:
        """Motion from a sampling time to ``span`` <= dt after it."""
        effects = []
        for column, delay, b in zip(self.columns, self.delays, self.B.T, strict=True):
            lag, late = _whole_samples(delay, dt)
            before, now = _two_parts(self.A, b, span, late)
            effects += [_Effect(column, lag, now)] if span > late else []
            effects += [_Effect(column, lag + 1, before)] if late > 0 else []
        return _Sampled(_held(self.A, self.B, span)[0], self.c, effects)


@dataclass(frozen=True, eq=False)
class ContinuousPlant:
    """A plant in continuous time: a transfer function from each input to each output.

    Parameters
    ----------
    channels : n_y sequences of n_u TransferFunction (or None where nothing acts)
        Row i holds the channels from the inputs u to output i.
    disturbance_channels : n_y sequences of n_v TransferFunction (or None), optional
        The same for measured disturbances v, which are held over a sample as u is.
    y_names, u_names, v_names : sequences of str, optional
        Names of the signals, handed on to the difference model.
    units : mapping from a signal's name to its unit, optional

    Raises
    ------
    ValueError
        If the rows do not have the same length or an entry is of another type.

    Examples
    --------
    A first-order lag with a dead time of 1.5 samples:

    >>> plant = ContinuousPlant([[TransferFunction([2.0], [10.0, 1.0], delay=1.5)]])
    >>> model = plant.difference_model(dt=1.0)
    >>> model.a.ravel().round(4), model.b.ravel().round(4)
    (array([-0.9048]), array([0.    , 0.0975, 0.0928]))
    """

    channels: Channels
    disturbance_channels: Channels | None = None
    y_names: Sequence[str] = ()
    u_names: Sequence[str] = ()
    v_names: Sequence[str] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        channels = _table("channels", self.channels)
        none: Channels = tuple(() for _ in channels)
        given = self.disturbance_channels
        if given in (None, none):  # the latter in a copy, or from a file
            disturbances = none
        else:
            disturbances = _table("disturbance_channels", given)
        if len(disturbances) != len(channels):
            raise ValueError(
                f"disturbance_channels has {len(disturbances)} rows; expected "
                f"{len(channels)}, one for each output as in channels"
            )
        object.__setattr__(self, "channels", channels)
        object.__setattr__(self, "disturbance_channels", disturbances)

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return len(self.channels)

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return len(self.channels[0])

    @property
    def n_v(self) -> int:
        """Number of measured disturbances."""
        return len(self._rows()[0]) - self.n_u

    def _rows(self) -> list[list[Channel]]:
        """Channels of each output, from the inputs and then the disturbances."""
        given = self.disturbance_channels
        assert given is not None  # set in __post_init__
        return [[*u, *v] for u, v in zip(self.channels, given, strict=True)]

    def steady_state_gain(self) -> Array:
        """Gain from inputs to outputs (n_y, n_u), infinite for integrators."""
        return np.array(
            [
                [c.steady_state_gain() if c else 0.0 for c in row]
                for row in self.channels
            ]
        )

    def poles(self) -> Array:
        """Poles of all channels, the largest first; shared ones of a row count once."""
        blocks = [block for row in self._rows() for block in _blocks(row)]
        poles = [np.linalg.eigvals(block.A) for block in blocks]
        return sort_by_size(np.concatenate([np.zeros(0, complex), *poles]))

    def sampled(self, dt: float, substeps: int = 1) -> LinearPlant:
        """Sample exactly, for inputs and disturbances held over each interval.

        The state holds the states of the channels and as many past inputs as the dead
        times need.

        Parameters
        ----------
        dt : float
            Sampling interval, in the unit of time of the channels: seconds or stated.
        substeps : int
            With more than one, outputs are also given, exactly, at this number of
            equally spaced times in an interval, its end included.

        Returns
        -------
        LinearPlant
            Its ``between`` has ``substeps`` times, or is None for ``substeps=1``.

        Raises
        ------
        ValueError
            If dt is not positive or substeps is smaller than 1.
        """
        _check_interval(dt)
        if substeps < 1:
            raise ValueError(f"substeps is {substeps}; expected at least 1")
        rows = [_blocks(row) for row in self._rows()]
        layout = _Layout.of(rows, self.n_u + self.n_v, dt)
        A, B, G = self._columns(layout, layout.transition(rows, dt))
        C = layout.output(rows, 0.0, dt)[:, : layout.n_x]
        between = None
        if substeps > 1:
            times = dt * np.arange(1, substeps + 1) / substeps
            moved = np.stack([layout.output(rows, time, dt) for time in times])
            between = Between(times, *self._columns(layout, moved))
        return LinearPlant(A, B, C, G, dt, between)

    def _columns(self, layout: _Layout, table: Array) -> tuple[Array, Array, Array]:
        """Split columns [x, u, v] of a table."""
        x, u, v = np.split(table, [layout.n_x, layout.n_x + self.n_u], axis=-1)
        return x, u, v

    def difference_model(self, dt: float) -> DifferenceModel:
        """Difference equation with exactly the sampled plant's response.

        Each output has one denominator, the least common multiple of those of its
        channels, without factors that cancel in all of them.  Dead times are leading
        zeros of b and g.

        Parameters
        ----------
        dt : float
            Sampling interval, in the unit of time of the channels: seconds or stated.

        Returns
        -------
        DifferenceModel
            With diagonal a, and the smallest na, nb and ng.

        Notes
        -----
        Modes that fade below rounding within one sample do not count for na.

        Sampling much faster than the plant moves puts all poles next to 1, where the
        coefficients of a high-order polynomial say little about its roots: the
        equation then loses digits that the sampled plant still has.

        Raises
        ------
        ValueError
            If dt is not positive.
        """
        _check_interval(dt)
        rows = [
            _equation([block.over(dt, dt) for block in _blocks(row)], len(row))
            for row in self._rows()
        ]
        names = {"y_names": self.y_names, "u_names": self.u_names}
        if self.n_v:
            names["v_names"] = self.v_names
        return _assemble(rows, self.n_u, dt, **names, units=self.units)


def difference_model(system: Any, dt: float | None = None) -> DifferenceModel:
    """Difference equation of a linear system from this or another package.

    Parameters
    ----------
    system : object
        A `TransferFunction` or `ContinuousPlant`, or any object with the attributes of
        SciPy's or python-control's transfer function (num, den), state space (A, B, C,
        D) or zeros, poles and gain, continuous or discrete, with any number of inputs
        and outputs.
    dt : float, optional
        Sampling interval.  Needed for a continuous system, which is sampled with held
        inputs; a discrete one brings its own (unless that is unspecified).

    Returns
    -------
    DifferenceModel
        Each output has one denominator.  The coefficients of a discrete transfer
        function with one denominator in a row are kept as they are.

    Raises
    ------
    ValueError
        If the system has feedthrough, is of an unknown kind, or if dt is missing or
        contradicts the system's own.

    Examples
    --------
    >>> import scipy.signal
    >>> lag = scipy.signal.TransferFunction([2.0], [10.0, 1.0])
    >>> difference_model(lag, dt=1.0).b.ravel().round(4)
    array([0.1903])
    """
    if isinstance(system, TransferFunction):
        system = ContinuousPlant([[system]])
    if isinstance(system, ContinuousPlant):
        return system.difference_model(_interval(None, dt)[0])
    own = getattr(system, "dt", None)
    if all(hasattr(system, name) for name in "ABCD"):
        return _from_state_space(system, *_interval(own, dt))
    channels = _polynomials(system)
    interval, continuous = _interval(own, dt)
    if continuous:
        table = [[_channel(*pair) for pair in row] for row in channels]
        return ContinuousPlant(table).difference_model(interval)
    rows = [_discrete_equation(row) for row in channels]
    return _assemble(rows, len(channels[0]), interval)


# Realisation and sampling of blocks


def _blocks(row: Sequence[Channel]) -> list[_Block]:
    """Group the channels of an output by denominator, in observer canonical form."""
    groups: dict[tuple[float, ...], list[tuple[int, TransferFunction]]] = {}
    for column, channel in enumerate(row):
        if channel is not None:
            monic = tuple(np.divide(channel.den, channel.den[0]).tolist())
            groups.setdefault(monic, []).append((column, channel))
    return [_block(np.array(den), members) for den, members in groups.items()]


def _block(den: Array, members: list[tuple[int, TransferFunction]]) -> _Block:
    numerators: list[Array] = [
        np.array(channel.num) / channel.den[0] for _, channel in members
    ]
    A, B, c = _balanced(*_observer_form(den, numerators))
    columns = [column for column, _ in members]
    return _Block(A, B, c, columns, [channel.delay for _, channel in members])


def _observer_form(
    den: Array, numerators: Sequence[Array]
) -> tuple[Array, Array, Array]:
    """Realise: A, B and c with c (pI - A)^-1 B = numerators / den, den monic."""
    n = len(den) - 1
    A: Array = np.eye(n, k=1)
    A[:, 0] -= den[1:]
    B = np.zeros((n, len(numerators)))
    for j, num in enumerate(numerators):
        B[n - len(num) :, j] = num
    return A, B, np.eye(n)[0]


def _balanced(A: Array, B: Array, c: Array) -> tuple[Array, Array, Array]:
    """Scale the states by powers of two so that rows and columns of A are alike."""
    balanced, (scale, _) = scipy.linalg.matrix_balance(A, permute=False, separate=True)
    return np.asarray(balanced, float), B / scale[:, None], c * scale


def _held(A: Array, B: Array, span: float) -> tuple[Array, Array]:
    """Transition over a span and effect of inputs held over all of it."""
    n, m = A.shape[0], B.shape[1]
    joint = np.zeros((n + m, n + m))
    joint[:n] = np.hstack([A, B]) * span
    moved = scipy.linalg.expm(joint)
    return moved[:n, :n], moved[:n, n:]


def _two_parts(A: Array, b: Array, span: float, late: float) -> tuple[Array, Array]:
    """Effects (n,) of the input before and after its step at time ``late``."""
    late = min(late, span)
    _, before = _held(A, b[:, None], late)
    rest, now = _held(A, b[:, None], span - late)
    return (rest @ before)[:, 0], now[:, 0]


def _whole_samples(delay: float, dt: float) -> tuple[int, float]:
    """Whole samples in a dead time, and what is left of it."""
    samples = delay / dt
    if abs(samples - round(samples)) < WHOLE:
        return round(samples), 0.0
    return int(samples), delay - int(samples) * dt


class _Layout(NamedTuple):
    """Where the states of blocks and past inputs stand in [x, w], w = [u, v]."""

    n_x: int
    history: list[int]  # first place of the past values of each input
    depth: list[int]  # how many past values of each input are kept

    @classmethod
    def of(cls, rows: Sequence[list[_Block]], n_w: int, dt: float) -> _Layout:
        n_blocks = 0
        depth = [0] * n_w
        for block in (block for row in rows for block in row):
            n_blocks += block.A.shape[0]
            for effect in block.over(dt, dt).effects:
                depth[effect.column] = max(depth[effect.column], effect.lag)
        places = np.cumsum([n_blocks, *depth])
        return cls(int(places[-1]), places[:-1].tolist(), depth)

    def place(self, column: int, lag: int) -> int:
        """Column of [x, w] that holds input ``column`` of ``lag`` samples ago."""
        return self.history[column] + lag - 1 if lag else self.n_x + column

    def transition(self, rows: Sequence[list[_Block]], dt: float) -> Array:
        """Map from [x_k, w_k] to x_{k+1}."""
        table = np.zeros((self.n_x, self.n_x + len(self.depth)))
        start = 0
        for block in (block for row in rows for block in row):
            moved = block.over(dt, dt)
            stop = start + len(block.c)
            table[start:stop, start:stop] = moved.A
            for column, lag, gain in moved.effects:
                table[start:stop, self.place(column, lag)] += gain
            start = stop
        for column, depth in enumerate(self.depth):
            for lag in range(1, depth + 1):
                table[self.place(column, lag), self.place(column, lag - 1)] = 1.0
        return table

    def output(self, rows: Sequence[list[_Block]], span: float, dt: float) -> Array:
        """Map from [x_k, w_k] to the outputs ``span`` after sample k."""
        table = np.zeros((len(rows), self.n_x + len(self.depth)))
        start = 0
        for i, block in ((i, block) for i, row in enumerate(rows) for block in row):
            moved = block.over(span, dt)
            stop = start + len(block.c)
            table[i, start:stop] = block.c @ moved.A
            for column, lag, gain in moved.effects:
                table[i, self.place(column, lag)] += block.c @ gain
            start = stop
        return table


# From sampled blocks to a difference equation


class _Equation(NamedTuple):
    """One output: a (na,) and b (lags, inputs), both starting at lag 1."""

    a: Array
    b: Array


def _equation(blocks: Sequence[_Sampled], n_w: int) -> _Equation:
    """Difference equation of an output that is the sum of blocks."""
    pairs = [
        (block.A, block.c, effect)
        for block in blocks
        for effect in block.effects
        if np.any(effect.gain)
    ]
    a = _denominator(blocks)
    n = len(a) - 1
    b = np.zeros((max((e.lag for *_, e in pairs), default=0) + max(n, 1), n_w))
    for A, c, effect in pairs:
        impulse = _impulse(A, effect.gain[:, None], c, n)[:, 0]
        terms = np.convolve(np.abs(a), np.abs(impulse))
        terms += np.abs(c) @ np.abs(effect.gain)
        numerator = _without_rounding(np.convolve(a, impulse)[:n], terms)
        b[effect.lag : effect.lag + n, effect.column] += numerator
    return _Equation(_without_rounding(a, a)[1:], b)


def _denominator(blocks: Sequence[_Sampled]) -> Array:
    """Least common denominator, [1, a_1, ...], of all effects on the output.

    The order is that of the reachable and observable part.  Directions below a
    tolerance are left out only if that leaves the impulse responses as they were;
    otherwise the tolerance is made sharper.
    """
    A, B, c = _stacked(blocks)
    full = _characteristic(A)
    impulse = _impulse(A, B, c, 2 * len(full))
    for tolerance in REDUCTIONS:
        a = _characteristic(_essential(A, B, c, tolerance))
        if _annihilates(a, impulse, np.abs(c) @ np.abs(B)):
            return a
    return full


def _characteristic(A: Array) -> Array:
    """Coefficients of det(zI - A), [1, a_1, ...]."""
    return np.real(np.poly(np.linalg.eigvals(A))) if A.size else np.ones(1)


def _stacked(blocks: Sequence[_Sampled]) -> tuple[Array, Array, Array]:
    """Blocks side by side, each output row and each effect scaled to length one."""
    used = [b for b in blocks if np.any(b.c) and any(e.gain.any() for e in b.effects)]
    if not used:
        return np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0)
    gains = [np.array([e.gain for e in b.effects if e.gain.any()]).T for b in used]
    B = scipy.linalg.block_diag(*gains)
    c = np.concatenate([b.c / np.linalg.norm(b.c) for b in used])
    A = scipy.linalg.block_diag(*(b.A for b in used))
    return A, B / np.linalg.norm(B, axis=0), c


def _essential(A: Array, B: Array, c: Array, tolerance: float) -> Array:
    """Transition matrix of the part that is both reachable and observable."""
    if not A.size:
        return A
    V = reachable_basis(A, B, tolerance)
    A, c = V.T @ A @ V, c @ V
    W = reachable_basis(A.T, c[:, None], tolerance)
    return W.T @ A @ W


def _impulse(A: Array, B: Array, c: Array, count: int) -> Array:
    """Values c A^k B for k = 0 .. count - 1, (count, m)."""
    values = np.empty((count, B.shape[1]))
    for k in range(count):
        values[k] = c @ B
        B = A @ B
    return values


def _annihilates(a: Array, impulse: Array, terms: Array) -> bool:
    """Whether every impulse response obeys the recursion a from its start on.

    ``terms`` (m,) is the size of the terms of which each response is a sum: a response
    that is only their rounding is zero.
    """
    n = len(a) - 1
    for response, size in zip(impulse.T, terms, strict=True):
        rest = np.convolve(a, response)[n : len(response)]
        scale = np.convolve(np.abs(a), np.abs(response)).max()
        allowed = max(UNCHANGED * scale, NEGLIGIBLE * size * np.abs(a).sum())
        if np.abs(rest).max(initial=0.0) > allowed:
            return False
    return True


def _without_rounding(values: Array, terms: Array) -> Array:
    """Set to zero what is only rounding of sums of terms of this size."""
    smallest = NEGLIGIBLE * np.abs(terms).max(initial=0.0)
    return np.where(np.abs(values) > smallest, values, 0.0)


def _order(coefficients: Array) -> int:
    """Count coefficients (or matrices) up to the last that is not zero."""
    used = np.flatnonzero([coefficient.any() for coefficient in coefficients])
    return int(np.max(used, initial=-1)) + 1


def _assemble(
    rows: Sequence[_Equation], n_u: int, dt: float, **names: Any
) -> DifferenceModel:
    """One model from the equations of the outputs; columns after n_u belong to v."""
    n_y = len(rows)
    a = np.zeros((max(1, *(_order(row.a) for row in rows)), n_y, n_y))
    b = np.zeros((max(len(row.b) for row in rows), n_y, rows[0].b.shape[1]))
    for i, row in enumerate(rows):
        a[: _order(row.a), i, i] = row.a[: _order(row.a)]
        b[: len(row.b), i] = row.b
    u, v = b[:, :, :n_u], b[:, :, n_u:]
    g = v[: max(1, _order(v))]
    return DifferenceModel(a, u[: max(1, _order(u))], g, dt=dt, **names)


# Systems of other packages


def _interval(own: Any, dt: float | None) -> tuple[float, bool]:
    """Find the sampling interval and whether the system is continuous."""
    continuous = own is None or (own is not True and own == 0)
    if dt is not None:
        _check_interval(dt)
    elif continuous or own is True:
        raise ValueError("dt is missing: the system does not state a sampling interval")
    if continuous or own is True:
        return float(dt or 0.0), continuous
    if dt is not None and not np.isclose(dt, own, rtol=1e-9, atol=0.0):
        raise ValueError(f"dt is {dt} but the system is sampled every {own}")
    return float(own), False


def _check_interval(dt: float) -> None:
    if not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt is {dt}; expected a positive number")


def _from_state_space(system: Any, dt: float, continuous: bool) -> DifferenceModel:
    """Row by row: the minimal denominator of each output of a state space."""
    A, B, C, D = (np.atleast_2d(np.asarray(getattr(system, m), float)) for m in "ABCD")
    if D.any():
        raise ValueError(
            f"the system has feedthrough, D = {D.tolist()}: {NO_FEEDTHROUGH}"
        )
    A, B, C = _balanced(A, B, C)
    A, B = _held(A, B, dt) if continuous else (A, B)
    effects = [_Effect(column, 0, gain) for column, gain in enumerate(B.T)]
    rows = [_equation([_Sampled(A, c, effects)], B.shape[1]) for c in C]
    return _assemble(rows, B.shape[1], dt)


def _polynomials(system: Any) -> list[list[tuple[Array, Array]]]:
    """Numerator and denominator of every channel, outputs by rows."""
    if hasattr(system, "num") and hasattr(system, "den"):
        num, den = system.num, system.den
        if np.isscalar(den[0]):  # SciPy: one denominator, a numerator an output
            return [[(row, np.asarray(den))] for row in np.atleast_2d(num)]
        return [list(zip(*row, strict=True)) for row in zip(num, den, strict=True)]
    if all(hasattr(system, name) for name in ("zeros", "poles", "gain")):
        num = system.gain * np.atleast_1d(np.poly(system.zeros))
        return [[(num, np.atleast_1d(np.poly(system.poles)))]]
    raise ValueError(
        f"system is a {type(system).__name__}; expected a transfer function (num, "
        "den), a state space (A, B, C, D) or zeros, poles and gain"
    )


def _channel(num: Array, den: Array) -> Channel:
    return TransferFunction(num.tolist(), den.tolist()) if np.any(num) else None


def _discrete_equation(row: Sequence[tuple[Array, Array]]) -> _Equation:
    """Equation of an output from transfer functions in z."""
    channels = [_channel(num, den) for num, den in row]
    blocks = _blocks(channels)
    if len(blocks) == 1:
        return _kept(channels)
    sampled = [
        _Sampled(
            block.A,
            block.c,
            [_Effect(j, 0, b) for j, b in zip(block.columns, block.B.T, strict=True)],
        )
        for block in blocks
    ]
    return _equation(sampled, len(row))


def _kept(channels: Sequence[Channel]) -> _Equation:
    """Coefficients as given, for channels with the same denominator."""
    den = next(np.divide(c.den, c.den[0]) for c in channels if c is not None)
    b = np.zeros((len(den) - 1, len(channels)))
    for column, channel in enumerate(channels):
        if channel is not None:
            num = np.divide(channel.num, channel.den[0])
            b[len(b) - len(num) :, column] = num
    return _Equation(den[1:], b)


# Checks


def _polynomial(name: str, values: Sequence[float]) -> tuple[float, ...]:
    """Coefficients without leading zeros."""
    array = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if array.ndim != 1 or not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is {values}; expected a list of finite numbers")
    if not array.any():
        what = "None is a channel that does nothing" if name == "num" else "not zero"
        raise ValueError(f"{name} has no coefficient other than zero; {what}")
    return tuple(np.trim_zeros(array, "f").tolist())


def _table(name: str, rows: Channels) -> tuple[tuple[Channel, ...], ...]:
    """Check rows of channels and make them immutable."""
    if isinstance(rows, TransferFunction) or not rows:
        raise ValueError(
            f"{name} is {rows}; expected a list of rows, [[G11, G12], ...]"
        )
    for i, row in enumerate(rows):
        for j, channel in enumerate(row):
            if not (channel is None or isinstance(channel, TransferFunction)):
                raise ValueError(
                    f"{name}[{i}][{j}] is a {type(channel).__name__}; "
                    "expected a TransferFunction or None"
                )
    lengths = {len(row) for row in rows}
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError(
            f"{name} has rows of {sorted(lengths)} channels; expected alike"
        )
    return tuple(tuple(row) for row in rows)
