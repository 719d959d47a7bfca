"""Reference governor: the same loop with and without it."""

import panel as pn

from apps.pages.live import Subject, live_page
from apps.session import GovernorChoices
from nmss_lab.plots import governor_charts

LOOK = {
    "governor_3_4": "The governor holds back the large step of the reference just "
    "enough for the input to stay within its limits; without it the input is clipped.",
    "double_integrator_4_4_1": "Nothing asks for a change of the reference, yet the "
    "governor moves it: disturbances drive the input towards its limits as well.",
    "ifac93_4_4_2": "Make the reference larger or the limits tighter until the "
    "governor has to act; w then leaves r.",
}

SUBJECT = Subject(
    "governor", "Reference governor", GovernorChoices, governor_charts, LOOK
)


def page() -> pn.Template:
    """Build the page for a new session."""
    return live_page(SUBJECT)
