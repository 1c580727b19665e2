r"""All roots of an analytic function in a rectangle: counted by Cauchy's argument principle, then located.

Along a closed path the argument of f turns by 2π times the number of roots inside. The path is divided into steps of at
most ``pace``. The caller sets ``pace`` to a small part of the distance between roots. With such a step, all distant
roots together turn the argument by some degrees, and a near root turns it by less than 180°. Each step is halved until
no step turns the argument by more than 60°. So no turn is missed, and none is wrong by 360°. A rectangle with several
roots is cut in two, until each part holds one root. Newton's method locates this root. If the method leaves the
rectangle, or if the function is flat, the rectangle is cut further. Rectangles without roots are dropped.

The count guards the result: the number of returned roots equals the count on the outer path, or `RootsLost` is raised.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

Function = Callable[[Any], NDArray[np.complex128]]

_MOST_TURN = np.pi / 3.0
_SMALLEST = 1e-7
"""Smallest size of a rectangle, as a share of the first one's size. Roots nearer to each other count as a double
root."""
_INSIDE_OUT = 0.4871
"""Position of the cut, as a share of the rectangle's side. Not the middle: a symmetric function may have a root
there."""


class RootsLost(ArithmeticError):
    """Failed search: the function is not analytic, has a root on the path, or its argument turns too fast."""


def count_in(f: Function, low: complex, high: complex, pace: float) -> int:
    """Return the number of roots in the rectangle from ``low`` (left, lower) to ``high``, with multiplicity."""
    corners = [low, complex(high.real, low.imag), high, complex(low.real, high.imag), low]
    turned = sum(_turn(f, a, b, pace) for a, b in pairwise(corners))
    count = turned / (2.0 * np.pi)
    if abs(count - round(count)) > 0.05:
        raise RootsLost(f"the argument turned {count:.3f} times")
    return round(count)


def count_right_of(f: Function, reach: float, pace: float, most: float, edge: float = 1e-9) -> int:
    """Return the number of roots with Re s > ``edge``, up to |Im s| = ``reach`` and Re s = min(``reach``, ``most``)."""
    return count_in(f, complex(edge, -reach), complex(min(reach, most), reach), pace)


def roots_in(f: Function, low: complex, high: complex, pace: float) -> list[complex]:
    """Return all roots in the rectangle. A path that meets a root is moved outwards a little. Raises `RootsLost`."""
    size = abs(high - low)
    for nudge in (0.0, 1e-4, 3.1e-4, 1.7e-3):
        shift = complex(nudge * size, nudge * size)
        try:
            count = count_in(f, low - shift, high + shift, pace)
            found = _within(f, low - shift, high + shift, count, pace, _SMALLEST * size)
        except RootsLost:
            continue
        if len(found) == count:
            return found
    raise RootsLost("no path round the rectangle is free of roots")


def _within(f: Function, low: complex, high: complex, count: int, pace: float, smallest: float) -> list[complex]:
    found: list[complex] = []
    waiting = [(low, high, count)]
    while waiting:
        low, high, count = waiting.pop()
        if count == 0:
            continue
        if count == 1:
            root = _newton(f, low, high)
            if root is not None:
                found.append(root)
                continue
        if abs(high - low) < smallest:
            found += [0.5 * (low + high)] * count
            continue
        waiting += _halves(f, low, high, count, pace)
    return found


def _halves(f: Function, low: complex, high: complex, count: int, pace: float) -> list[tuple[complex, complex, int]]:
    for share in (_INSIDE_OUT, 0.4413, 0.5602, 0.3721):
        if high.real - low.real > high.imag - low.imag:
            cut = low.real + share * (high.real - low.real)
            parts = [(low, complex(cut, high.imag)), (complex(cut, low.imag), high)]
        else:
            cut = low.imag + share * (high.imag - low.imag)
            parts = [(low, complex(high.real, cut)), (complex(low.real, cut), high)]
        try:
            first = count_in(f, *parts[0], pace)
        except RootsLost:
            continue      # a root on the cut
        return [(*parts[0], first), (*parts[1], count - first)]
    raise RootsLost("no cut is free of roots")


def _newton(f: Function, low: complex, high: complex) -> complex | None:
    """Return the single root inside, or None if Newton's method leaves the rectangle or does not converge."""
    here = 0.5 * (low + high)
    size = abs(high - low)
    step = 1e-6 * max(size, 1e-3)
    for _ in range(60):
        values = f(np.array([here, here + step, here - step, here + 1j * step, here - 1j * step]))
        slope = (values[1] - values[2] - 1j * (values[3] - values[4])) / (4.0 * step)
        if slope == 0.0:
            return None
        move = complex(values[0] / slope)
        if abs(move) > size:
            return None
        here -= move
        if not (low.real <= here.real <= high.real and low.imag <= here.imag <= high.imag):
            return None
        if abs(move) < 1e-12 * max(1.0, abs(here)):
            return here
    return None


def _turn(f: Function, start: complex, end: complex, pace: float) -> float:
    """Return the change of the argument of f, rad, along the straight line from ``start`` to ``end``."""
    at = np.linspace(0.0, 1.0, 9 + ceil(abs(end - start) / pace))
    values = f(start + (end - start) * at)
    for _ in range(40):
        if not np.all(np.isfinite(values)) or np.any(values == 0.0):
            raise RootsLost("the function vanishes on the path, or is not finite")
        turns = np.angle(values[1:] / values[:-1])
        coarse = np.flatnonzero(np.abs(turns) > _MOST_TURN)
        if coarse.size == 0:
            return float(np.sum(turns))
        if at.size > 400_000:
            break
        middle = 0.5 * (at[coarse] + at[coarse + 1])
        if np.any(middle <= at[coarse]):
            break
        new = f(start + (end - start) * middle)
        at = np.insert(at, coarse + 1, middle)
        values = np.insert(values, coarse + 1, new)
    raise RootsLost("the argument turns too fast to be followed")
