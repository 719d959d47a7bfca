"""Receding horizon: plan, act, plan again, with up to three structures at once."""

import panel as pn

from apps.pages.live import Subject, live_page
from apps.session import LoopChoices
from nmss_lab.plots import loop_charts

LOOK = {
    "governor_3_4": "Press play and watch each plan bend along the limits of the "
    "input: what is carried out is only ever its first move.",
    "double_integrator_4_4_1": "An output disturbance, then an input disturbance: "
    "only a plan with the sum of the error comes back without an offset.",
    "ifac93_4_4_2": "Plans of a first-order model miss the resonance of the plant: "
    "switch on past plans and see where they part from what happened.",
    "shell_5_3_2": "Three references step one after the other: look at the other two "
    "outputs while one of them moves.",
    "marginally_stable_6_3_2": "Compare feedback and forward path after the "
    "disturbances at the input and at the output.",
    "ifac93_6_3_3": "Forward path and feedback agree with an exact model: make the "
    "plant differ and see which of them keeps its shape.",
}

SUBJECT = Subject(
    "receding_horizon", "Receding horizon", LoopChoices, loop_charts, LOOK
)


def page() -> pn.Template:
    """Build the page for a new session."""
    return live_page(SUBJECT)
