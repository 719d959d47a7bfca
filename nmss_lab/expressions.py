"""Coefficients written as texts, such as ``0.3*y[k-1]**2 + exp(-y[k-2])``.

A text is read once: Python's parser gives a tree, a short list of allowed nodes turns
it into numpy functions, and all else is refused.  No part of a text is ever executed.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial, reduce
from numbers import Real
from typing import Any, NoReturn
from unicodedata import normalize

import numpy as np

from nmss_lab.models import Array

MAX_LENGTH, MAX_NODES, MAX_DEPTH, MAX_LAG = 500, 200, 40, 50
"""Limits of a text: characters; numbers, names and operations; nesting; lags."""

Function = Callable[..., Any]

Value = Callable[[Array, Array], Any] | np.float64
"""A function of past outputs and inputs, or a number where neither is read."""


@dataclass(frozen=True)
class Expression:
    """A function of past outputs and inputs, written as a text.

    A text holds numbers, constants, ``pi``, ``+ - * / **``, parentheses, functions
    (``exp log sqrt sin cos tan tanh abs min max``) and past values such as ``y[k-1]``.
    Signals go by number (``y1``, ``y2``, ..., ``u1``), by their names and, where there
    is only one, by ``y`` and ``u``.

    Parameters
    ----------
    text : str
    y_names, u_names : tuples of str
        Names of the outputs and inputs, one a signal.
    constants : mapping from a name to a number, optional
        Numbers that the text may use by name.

    Raises
    ------
    ValueError
        If the text cannot be read (the message has the text and the column), a name
        has two meanings, or a constant is not a finite number.

    Examples
    --------
    >>> gain = Expression("c*y[k-2]**2 + T[k-1]", u_names=("T",), constants={"c": 0.5})
    >>> gain.y_lags, gain.u_lags
    (2, 1)
    >>> y, u = np.array([[1.0], [2.0]]), np.array([[3.0]])
    >>> float(gain(y, u))
    5.0
    """

    text: str
    y_names: tuple[str, ...] = ("y",)
    u_names: tuple[str, ...] = ("u",)
    constants: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Copy the arguments and read the text."""
        for key, kind in (("y_names", tuple), ("u_names", tuple), ("constants", dict)):
            object.__setattr__(self, key, kind(getattr(self, key)))
        _ = self._parsed

    @cached_property
    def _parsed(self) -> tuple[Value, dict[str, int]]:
        reader = _Reader(self)
        with np.errstate(all="ignore"):
            return reader.read(), reader.lags

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what it was made from: its functions cannot be."""
        return type(self), (self.text, self.y_names, self.u_names, self.constants)

    @property
    def y_lags(self) -> int:
        """Deepest lag of an output that is read: 2 for ``y[k-2]``, 0 for none."""
        return self._parsed[1]["y"]

    @property
    def u_lags(self) -> int:
        """Deepest lag of an input that is read, 0 for none."""
        return self._parsed[1]["u"]

    @property
    def bare(self) -> Value:
        """What ``__call__`` evaluates, without its care for kinds and shapes."""
        return self._parsed[0]

    def __call__(self, y: Array, u: Array) -> Array:
        """Evaluate at past values, for all leading axes at once.

        Complex values are for the complex-step derivative: ``abs``, ``min`` and
        ``max`` then go by the real part, and of equals take the first.

        Parameters
        ----------
        y, u : arrays (..., lags, n_y), (..., lags, n_u)
            y_{k-1}, y_{k-2}, ... and u_{k-1}, u_{k-2}, ...

        Returns
        -------
        array (...)
            Not finite where the text is not: ``log`` of a negative number is nan.

        Raises
        ------
        ValueError
            If there are fewer lags or signals than the text reads.
        """
        value, lags = self._parsed
        y, u = _floats(y), _floats(u)
        lead = y.shape[:-2]
        if u.shape[:-2] != lead:
            lead = np.broadcast_shapes(lead, u.shape[:-2])
        try:
            with np.errstate(all="ignore"):
                found = value(y, u) if callable(value) else value
        except IndexError as error:
            raise ValueError(
                f'"{self.text}": y has shape {y.shape}, u {u.shape}; expected '
                f"(..., {lags['y']} or more, {len(self.y_names)}) and "
                f"(..., {lags['u']} or more, {len(self.u_names)})"
            ) from error
        filled = np.empty(lead, found.dtype)  # never a view of y or u
        filled[...] = found
        return filled


def _floats(values: Array) -> Array:
    return values if values.dtype.kind in "fc" else values.astype(float)


def _either(real: Function, step: Function) -> Function:
    """Take numpy's own function, and another one for the complex step."""

    def function(*x: Any) -> Any:
        return step(*x) if "c" in [each.dtype.kind for each in x] else real(*x)

    return function


def _power(x: Any, p: Any) -> Any:
    # the logarithm of a negative x would lose the step beside i pi: take out the sign
    if isinstance(p, float) and p.is_integer() and abs(p) < 100:
        return x**p  # numpy multiplies
    sign = np.where(x.real < 0, np.power(-1.0, p.real), 1.0)
    size = np.where(x.real < 0, -x, x)
    return np.where(size == 0, size.real**p.real, sign * size**p)


def _from_zero(function: Function, x: Array) -> Array:
    return np.where(x.real < 0, complex(np.nan, np.nan), function(x))


def _first(better: Array, a: Array, b: Array) -> Array:
    return np.where(better | np.isnan(a), a, b)  # nan stays, from either


_smaller = _either(np.minimum, lambda a, b: _first(a.real <= b.real, a, b))
_larger = _either(np.maximum, lambda a, b: _first(a.real >= b.real, a, b))

FUNCTIONS: Mapping[str, Function] = {
    "exp": np.exp,
    "log": _either(np.log, partial(_from_zero, np.log)),
    "sqrt": _either(np.sqrt, partial(_from_zero, np.sqrt)),
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "tanh": np.tanh,
    "abs": _either(np.abs, lambda x: np.where(x.real < 0, -x, x)),
}
"""Functions of one argument."""

CHOICES: Mapping[str, Function] = {
    "min": lambda *values: reduce(_smaller, values),
    "max": lambda *values: reduce(_larger, values),
}
"""Functions of two or more."""

OPERATORS: Mapping[type[ast.operator], Function] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: _either(operator.pow, _power),
}

READABLE = re.compile(
    r"(?:(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][-+]?[0-9]++)?(?![\w.])"  # numbers
    r"|[^\W\d²³][^\W²³]*+|[-+*/()\[\],]|\s)*+"  # names, signs, space
)


class _Reader:
    """Turns one text into a function and keeps the deepest lags it reads."""

    def __init__(self, expression: Expression) -> None:
        if not isinstance(expression.text, str):
            raise ValueError(f"{expression.text!r} is not a text")
        self.text = re.sub(r"\s", " ", expression.text.strip())
        self.lags, self.nodes = {"y": 0, "u": 0}, 0
        self.names: dict[str, tuple[str, Any]] = {}
        for own, meaning in _meanings(expression):
            name = normalize("NFKC", own)  # as the parser does
            if self.names.setdefault(name, meaning) != meaning:
                self._refuse(
                    f"the name {own} has two meanings; expected different names for "
                    "outputs, inputs, constants, functions and k"
                )
            if meaning[0] == "number" and not np.isfinite(meaning[1]):
                self._refuse(f"the constant {own} is not a finite number")

    def read(self) -> Value:
        """Check what can be checked without the parser, parse, and build."""
        if not 1 <= len(self.text) <= MAX_LENGTH:
            self._refuse(f"{len(self.text)} characters; expected 1 to {MAX_LENGTH}")
        at = READABLE.match(self.text).end()  # type: ignore[union-attr]  # takes ""
        for wrong in re.findall(r"[\w.]+|.", self.text[at:])[:1]:
            hint = "write ** for powers" if wrong in "^²³" else self._allowed()
            self._refuse(f"cannot read {wrong!r}; {hint}", at)
        try:
            return self._build(ast.parse(self.text, mode="eval").body)
        except SyntaxError as error:
            at = (error.offset or len(self.text) + 1) - 1
            self._refuse(f"{error.msg}; {self._allowed()}", at)
        except (RecursionError, MemoryError):
            self._refuse(f"too many brackets; expected at most {MAX_DEPTH} levels")

    def _build(self, node: ast.expr, depth: int = 1) -> Value:
        self.nodes += 1
        if self.nodes > MAX_NODES or depth > MAX_DEPTH:
            self._refuse(
                f"too long; expected at most {MAX_NODES} numbers, names and signs, "
                f"{MAX_DEPTH} of them within each other or in one sum"
            )
        match node:
            case ast.Constant(int() | float() as value) if type(value) is not bool:
                return self._finite(_number(value), node)
            case ast.Name(name) if self._is(name, "number"):
                return np.float64(self.names[name][1])
            case ast.Subscript(ast.Name(name)) if self._is(name, "y", "u"):
                return self._past(name, node)
        function, arguments = self._operation(node)
        parts = [self._build(argument, depth + 1) for argument in arguments]
        if any(callable(part) for part in parts):
            return _join(function, *map(_call, parts))
        return self._finite(np.float64(function(*parts)), node)

    def _operation(self, node: ast.expr) -> tuple[Function, list[ast.expr]]:
        """Split a node into a function and its arguments."""
        match node:
            case ast.UnaryOp(ast.USub(), inner):
                return operator.neg, [inner]
            case ast.BinOp(left, sign, right) if type(sign) in OPERATORS:
                return OPERATORS[type(sign)], [left, right]
            case ast.Call(ast.Name(name), [_], []) if self._is(name, "function"):
                return FUNCTIONS[name], node.args
            case ast.Call(ast.Name(name), [_, _, *_], []) if self._is(name, "choice"):
                return CHOICES[name], node.args
        self._refuse(f"cannot read {self._part(node)}; {self._allowed()}", node)

    def _past(self, name: str, node: ast.Subscript) -> Value:
        match node.slice:
            case ast.BinOp(ast.Name("k"), ast.Sub(), ast.Constant(int(lag))):
                known = 1 <= lag <= MAX_LAG and lag is not True
            case _:
                known = False
        if not known:
            past = f"{name}[k-1], {name}[k-2], ... {name}[k-{MAX_LAG}]"
            self._refuse(f"only past values {past} may be read", node)
        letter, channel = self.names[name]
        self.lags[letter] = max(self.lags[letter], lag)
        where = (..., lag - 1, channel)
        # a number is calculated with faster than an array of no dimension: [()]
        if letter == "y":
            return lambda y, u: y[where][()]
        return lambda y, u: u[where][()]

    def _is(self, name: str, *kinds: str) -> bool:
        return name in self.names and self.names[name][0] in kinds

    def _finite(self, number: np.float64, node: ast.expr) -> np.float64:
        if not np.isfinite(number):
            self._refuse(f"{self._part(node)} is not finite", node)
        return number

    def _allowed(self) -> str:
        numbers = [name for name in self.names if self._is(name, "number")]
        signals = [f"{name}[k-1]" for name in self.names if self._is(name, "y", "u")]
        words = ", ".join(["numbers", *numbers, *signals])
        return (
            f"expected {words}, + - * / ** ( ), {' '.join(FUNCTIONS)} of one argument, "
            f"{' '.join(CHOICES)} of two or more"
        )

    def _part(self, node: ast.expr) -> str:
        return (ast.get_source_segment(self.text, node) or "")[:60]

    def _refuse(self, why: str, at: ast.expr | int | None = None) -> NoReturn:
        if isinstance(at, ast.expr):  # the parser counts bytes
            at = len(self.text.encode()[: at.col_offset].decode())
        place = "" if at is None else f"column {at + 1}: "
        short = self.text if len(self.text) <= MAX_LENGTH else self.text[:60] + "..."
        raise ValueError(f'"{short}": {place}{why}')


def _meanings(expression: Expression) -> Iterator[tuple[str, tuple[str, Any]]]:
    """Yield every name with its kind and what it stands for."""
    for letter, names in (("y", expression.y_names), ("u", expression.u_names)):
        if len(names) == 1:
            yield letter, (letter, 0)
        for i, own in enumerate(names):
            yield from ((name, (letter, i)) for name in (f"{letter}{i + 1}", own))
    yield "k", ("sample", None)
    yield "pi", ("number", np.pi)
    yield from ((name, ("function", None)) for name in FUNCTIONS)
    yield from ((name, ("choice", None)) for name in CHOICES)
    for name, value in expression.constants.items():
        yield name, ("number", float(_number(value)))


def _join(function: Function, *calls: Function) -> Value:
    """Apply a function to the values of its parts."""
    if len(calls) == 2:  # most are, and this is faster
        first, second = calls
        return lambda y, u: function(first(y, u), second(y, u))
    return lambda y, u: function(*[call(y, u) for call in calls])


def _call(part: Value) -> Function:
    return part if callable(part) else lambda y, u: part


def _number(value: Any) -> np.float64:
    """Nearest float: infinite if it is too large, nan if it is no real number."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return np.float64(np.nan)
    try:
        return np.float64(float(value))
    except OverflowError:
        return np.float64(np.inf)
