"""Run before a lesson, in its kernel: sliders answer beforehand, as `pn.config.embed`.

A slider with many values is asked for some of them, evenly spread: many if it is
alone, few if there are several, whose answers multiply.
"""

import panel as pn
import param
from panel import viewable

MANY = {1: 21, 2: 6}
embed_state = viewable.embed_state


def _let_go(event):
    """Tell what waits for the end of a drag that a value is chosen."""
    with param.edit_constant(event.obj):
        event.obj.value_throttled = event.new


def _embed(shown, model, doc, **options):
    """Ask the controls of what is shown for their answers."""
    controls = shown.select(pn.widgets.Widget) if hasattr(shown, "select") else []
    for control in controls:
        if "value_throttled" in control.param:
            control.param.watch(_let_go, "value")
    options |= {"max_opts": MANY.get(len(controls), 3), "progress": False}
    return embed_state(shown, model, doc, **options)


viewable.embed_state = _embed
pn.config.embed = True
