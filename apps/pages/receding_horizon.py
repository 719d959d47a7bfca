"""Receding horizon: plan, act, plan again, with up to three structures at once."""

import panel as pn

from apps.pages.live import Subject, live_page
from apps.session import LoopChoices
from nmss_lab.plots import loop_charts

LOOK = {
    "governor_3_4": "Press play and watch each plan bend along the limits of the "
    "input: what is carried out is only ever its first move.",
    "double_integrator_4_4_1": "An output disturbance at 5 s, an input disturbance at "
    "20 s: see how far each structure goes to its limits to take them out.",
    "ifac93_4_4_2": "Plans of a first-order model miss the resonance of the plant: "
    "switch on past plans and see where they part from what happened.",
    "shell_5_3_2": "Three references step one after the other: look at the other two "
    "outputs while one of them moves.",
    "marginally_stable_6_3_2": "Compare feedback and forward path after the "
    "disturbances at the input and at the output.",
    "ifac93_6_3_3": "Plans bend along the limit of the input after every step: now "
    "raise the gain of the plant and see which structure keeps its shape.",
    "gasifier_6_3_4": "The sink pressure swings for ever: see which of four outputs "
    "pays when the inputs are at their limits.",
    "measured_disturbance_7_4_1": "One controller measures the disturbance, the other "
    "finds out from the output: look at the first samples after it sets in.",
    "temperature_7_4_2": "Synthetic days with a cold night and an open door: the "
    "measured surroundings let one controller act before the rooms feel it.",
    "quadruple_tank_minus": "One level steps and pulls the other along: compare what "
    "the two pumps do about it.",
    "quadruple_tank_plus": "The same tanks with a right-hand zero: no tuning makes "
    "this one fast, see what happens if you try.",
    "wood_berry": "Long dead times: the plan has to wait for its own moves to arrive, "
    "shorten the horizon below them and see.",
}

SUBJECT = Subject(
    "receding_horizon", "Receding horizon", LoopChoices, loop_charts, LOOK
)


def page() -> pn.Template:
    """Build the page for a new session."""
    return live_page(SUBJECT)
