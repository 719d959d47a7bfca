"""Entry point of the live pages: which there are, and the index of them."""

import html
import logging
from collections.abc import Callable

import panel as pn
from panel.viewable import Viewable

from apps.pages import (
    disturbances,
    governor,
    identify,
    receding_horizon,
    robustness,
    state_dependent,
    structures,
    tune,
    workbench,
)
from apps.pages.live import Subject, page_template, text_style
from apps.session import known_case
from nmss_lab.cases import CASES

THREADS = 4

INDEX = """
<h1>Predictive control, live</h1>
<p>Every plot answers while you move a slider, and every run can be played: see the
controller plan, act, and plan again.</p>
<div class="cards">
<a class="card" href="workbench"><b>Workbench</b>
From a record of your plant to a verified design in seven steps, each with its state,
its numbers and its picture, and a report at the end.</a>
<a class="card" href="receding_horizon"><b>Receding horizon</b>
Up to three control structures side by side on the worked examples, with limits,
disturbances, and a plant that differs from its model.</a>
<a class="card" href="structures"><b>Structures</b>
All structures on one plant, one disturbance, one sheet of scores: hidden modes, poles,
sensitivities, and how each follows and recovers.</a>
<a class="card" href="governor"><b>Reference governor</b>
One loop with and without a governor that bends the reference just enough to keep
every limit.</a>
<a class="card" href="disturbances"><b>Disturbances</b>
A disturbance that is measured, and the same controller without the measurement: on one
loop, and in a building whose zones take colour as it plays.</a>
<a class="card" href="identify"><b>Identify</b>
From a record, shipped or your own, to a ranked table of models with honest
uncertainty, and from there to a controller.</a>
<a class="card" href="tune"><b>Tune</b>
Say what the loop should become, goal by goal, and watch what can be attained and at
what price.</a>
<a class="card" href="state_dependent"><b>State-dependent control</b>
Plants whose coefficients move with the plan: watch predictions settle, swing or run
away, over time and pass by pass within one sample, beside the true optimum.</a>
<a class="card" href="robustness"><b>Robustness</b>
How the loop behaves for the plants one does not have: thousands of them, their poles,
bands and rates, how often and how badly, and each one to look into.</a>
</div>
<h2>Start from an example</h2>
"""


def index() -> pn.Template:
    """Build the page that leads to the others."""
    page = page_template("", "Predictive control in the non-minimal state space")
    subjects = (
        receding_horizon.SUBJECT,
        governor.SUBJECT,
        disturbances.SUBJECT,
        state_dependent.SUBJECT,
    )
    lists = "".join(_examples(subject) for subject in subjects)
    text = pn.pane.HTML(
        INDEX + lists, stylesheets=[text_style()], sizing_mode="stretch_width"
    )
    page.add_panel("index", text)
    return page


def _examples(subject: Subject) -> str:
    """List the cases of a page, each with what to look at."""
    entries = "".join(
        f'<dt><a href="{subject.path}?case={name}">{html.escape(title)}</a></dt>'
        f"<dd>{html.escape(subject.look[name])}</dd>"
        for name in subject.choices.cases()
        if name in CASES
        for title in [known_case(name).title]
    )
    return f"<h3>{html.escape(subject.heading)}</h3><dl>{entries}</dl>"


def pages() -> dict[str, Callable[[], Viewable]]:
    """Give the builders of all pages by path; the empty path is the index.

    Choices are worked on in a few threads, so that one session's long run does not
    keep the others waiting.
    """
    pn.config.nthreads = THREADS
    # Limits that cannot all be kept are an ordinary sight here; the page tells of them.
    logging.getLogger("nmss_lab").setLevel(logging.ERROR)
    return {
        "": index,
        "workbench": workbench.page,
        "receding_horizon": receding_horizon.page,
        "governor": governor.page,
        "disturbances": disturbances.page,
        "identify": identify.page,
        "tune": tune.page,
        "state_dependent": state_dependent.page,
        "robustness": robustness.page,
        "structures": structures.page,
    }
