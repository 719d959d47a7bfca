"""State-dependent control: predictions that settle, over time and within a sample."""

from typing import Any

import panel as pn

from apps.pages.live import Subject, live_page
from apps.varying import VaryingChoices
from nmss_lab.plots import Chart, inside_charts, passes_in_words, varying_charts

LOOK = {
    "bilinear_8_5_1": "Both PIP laws are meant to reach the reference in two samples: "
    "once the input is limited, the one that sums changes weighed with a varying gain "
    "overshoots, and the governor bends the reference instead.",
    "product_8_5_2": "Switch on past plans: frozen predictions are corrected sample by "
    "sample, settled ones lie on each other. Then look into sample 5, pass by pass.",
    "conical_tank": "On the way down, where the tank becomes fast, iterated "
    "predictions swing or creep: crosses mark samples that did not settle.",
    "stirred_reactor": "The reactor is unstable. Frozen predictions lose it, iterated "
    "ones do not always settle, true derivatives hold it.",
    "own": "Your own equation: type coefficients that depend on past outputs and "
    "inputs, such as 0.3*y[k-1]**2, and watch whether the predictions settle.",
}


def _inside(choices: VaryingChoices) -> tuple[list[Chart], list[dict[str, Any]]]:
    """Charts and words of the passes within the chosen sample."""
    passes, best, run = choices.passes_inside()
    charts = inside_charts(
        passes, best, run, choices.inside, choices.output, choices.input
    )
    return charts, passes_in_words(passes)


SUBJECT = Subject(
    "state_dependent",
    "State-dependent control",
    VaryingChoices,
    varying_charts,
    LOOK,
    _inside,
)


def page() -> pn.Template:
    """Build the page for a new session."""
    return live_page(SUBJECT)
