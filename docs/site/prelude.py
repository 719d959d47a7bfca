"""Run before a lesson, in its kernel: sliders answer beforehand, as `pn.config.embed`.

A slider with many values is asked for some of them, evenly spread, with both its ends
and the value it starts from: many if it is alone, few if there are several, whose
answers multiply.
"""

from itertools import product
from math import ceil

import panel as pn
import param
from panel import viewable
from panel.io import embed

MANY = {1: 25, 2: 8}
embed_state = viewable.embed_state


def _let_go(event):
    """Tell what waits for the end of a drag that a value is chosen."""
    with param.edit_constant(event.obj):
        event.obj.value_throttled = event.new


def _values(slider, most):
    """Return where a slider is asked: about ``most`` of its steps, evenly spread."""
    steps = (slider.end - slider.start) / slider.step
    stride = max(ceil(steps / (most - 1) - 1e-9), 1)
    asked = range(0, ceil(steps - 1e-9), stride)
    # Rounded, since 0.1 + 0.05 is not 0.15.
    ticks = {round(slider.start + i * slider.step, 10) for i in asked}
    return sorted(ticks | {slider.value, slider.end})


def _again(*values):
    """Return all choices, and the first again.

    A page that starts with it has nothing to do for it, and would not know the way
    back.
    """
    choices = list(product(*values))
    return choices + choices[:1]


def _embed(shown, model, doc, **options):
    """Ask the controls of what is shown for their answers."""
    controls = shown.select(pn.widgets.Widget) if hasattr(shown, "select") else []
    most, states = MANY.get(len(controls), 3), {}
    for control in controls:
        if "value_throttled" in control.param:
            control.param.watch(_let_go, "value")
        if isinstance(control, pn.widgets.IntSlider | pn.widgets.FloatSlider):
            states[control] = _values(control, most)
    options |= {"states": states, "progress": False}
    return embed_state(shown, model, doc, **options)


embed.product = _again
viewable.embed_state = _embed
pn.config.embed = True
