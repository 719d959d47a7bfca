"""Reference governor: the same loop with and without it."""

import panel as pn

from apps.pages.live import Subject, live_page
from apps.session import GovernorChoices
from nmss_lab.plots import governor_charts

LOOK = {
    "governor_3_4": "The governor holds back the large step of the reference just "
    "enough for the input to stay within its limits; without it the input is clipped.",
    "double_integrator_4_4_1": "The disturbances are not measured: the governor counts "
    "on predictions that miss them, bends w for good and leaves an offset which the "
    "clipped gain alone takes out.",
    "ifac93_4_4_2": "Make the reference larger or the limits tighter until the "
    "governor has to act; w then leaves r.",
    "shell_5_3_2": "The limits are wide here: choose your own on the change du until "
    "w has to leave r, and see whether the other outputs notice.",
    "marginally_stable_6_3_2": "Nothing is at a limit yet: choose limits of your own "
    "on u, tighter and tighter, and compare what clipping and bending do.",
    "ifac93_6_3_3": "The integral loop is slow enough for its limits; make the "
    "reference three times as large and watch w.",
    "gasifier_6_3_4": "Without a governor the clipped inputs lose an output far and "
    "wide; the governor bends four references at nearly every sample.",
    "measured_disturbance_7_4_1": "A disturbance that is measured enters the "
    "governor's predictions; choose limits of your own on u and see what w does.",
    "temperature_7_4_2": "The heaters are at their limits all day: see which room's "
    "reference gives way.",
    "quadruple_tank_minus": "Choose limits of your own on the pumps until w leaves r.",
    "quadruple_tank_plus": "A right-hand zero answers the wrong way first: choose "
    "limits of your own on u and see how early w has to turn.",
    "wood_berry": "Only four samples touch a limit, and yet w swings far: long dead "
    "times let the reference be bent without the outputs noticing.",
}

SUBJECT = Subject(
    "governor", "Reference governor", GovernorChoices, governor_charts, LOOK
)


def page() -> pn.Template:
    """Build the page for a new session."""
    return live_page(SUBJECT)
