"""Measured disturbances: the same controller with and without the measurement."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

import numpy as np
import panel as pn
import param
from panel.custom import JSComponent

from apps.disturbances import DisturbanceChoices
from apps.pages.live import LivePage, Subject, _number
from apps.player import STYLE, script
from apps.session import plain
from nmss_lab.cases import FloorPlan
from nmss_lab.plots import Chart, disturbance_charts
from nmss_lab.simulate import Run

LOOK = {
    "measured_disturbance_7_4_1": "The disturbance is noise, and from sample 50 on its "
    "mean is another one: both controllers take out the mean, only one takes out the "
    "noise. Now let plans continue v along a line.",
    "temperature_7_4_2": "At hour 55 somebody opens a large door: play on, and see "
    "which controller warms the air before the zones turn blue. Then change what plans "
    "take v to be.",
    "wood_berry": "The feed reaches the products late, reflux and steam do too: see "
    "how much of its step at 135 min a measurement takes away.",
}

COLUMNS = {
    "peak": "Peak deviation{y}",
    "IAE": "IAE",
    "travel": "Travel of the input{u}",
}


class Floor(JSComponent):
    """Floor plans that follow the player; nothing is shown without "runs".

    ``plan`` comes from the server: see ``floor``.
    """

    plan = param.Dict(default={})

    _esm = script("floor.js")
    _stylesheets = (STYLE,)


def floor(plan: FloorPlan | None, runs: Mapping[str, Run]) -> dict[str, Any]:
    """Gather what ``Floor`` draws of runs over a plan, nothing without one."""
    if plan is None:
        return {}
    first = next(iter(runs.values()))
    model = first.controller.model
    low, high = (
        [float(x) if np.isfinite(x) else None for x in side]
        for side in first.controller.limits.of("u", model.n_u)
    )
    return {
        "length": plan.length,
        "width": plan.width,
        "zones": [vars(zone) for zone in plan.zones],
        "actuators": [
            {
                **vars(each),
                "low": low[each.input],
                "high": high[each.input],
                "unit": _unit(model.units.get(model.u_names[each.input], "")),
            }
            for each in plan.actuators
        ],
        "outside": model.v_names[plan.outside].capitalize(),
        "unit": _unit(model.units.get(model.y_names[0], "")),
        "full": plan.full,
        "samples": len(first),
        "outputs": model.n_y,
        "inputs": model.n_u,
        "r": _packed(first.r),
        "v": _packed(first.v[:, plan.outside]),
        "runs": [
            {
                "name": name,
                "style": style,
                "knows": _knows(run),
                "y": _packed(run.y),
                "u": _packed(run.u),
            }
            for style, (name, run) in enumerate(runs.items())
        ],
    }


def _packed(values: Any) -> Any:
    return np.asarray(values, np.float32).ravel()


def _unit(unit: str) -> str:
    """Write a unit as it stands after a number."""
    factor = "\u00d7 " if unit[:1].isdigit() else ""
    return factor + unit.replace("degC", "\u00b0C").replace("m3", "m\u00b3")


def _knows(run: Run) -> str:
    form = getattr(run.controller, "form", None)
    return "sees v" if getattr(form, "lags", ()) else "does not see v"


class DisturbancePage(LivePage):
    """One session's page, with floor plans where the case has one."""

    def __init__(self) -> None:
        self.floor = Floor(sizing_mode="stretch_width")
        super().__init__(SUBJECT)

    def _compute(self) -> tuple[dict[str, Run], list[Chart]]:
        choices, runs = self.choices, self.choices.runs()
        named = {plain(name): run for name, run in runs.items()}
        shown = choices.output, choices.input, choices.disturbance
        return runs, disturbance_charts(named, *shown)

    def _start(self) -> int:
        """Begin where the disturbance does."""
        return int(self.choices.onset)

    def _measure(self) -> None:
        """Show what was measured over the whole run, and after the disturbance."""
        super()._measure()
        self.floor.plan = floor(self.choices.example.plan, self._named())
        self.measures.object += self._rejected()

    def _rejected(self) -> str:
        choices, model = self.choices, self.choices.example.model
        names = {
            "y": model.y_names[choices.output],
            "u": model.u_names[choices.input],
        }
        units = {key: model.units.get(name, "") for key, name in names.items()}
        units = {key: f" [{unit}]" if unit else "" for key, unit in units.items()}
        titles = [html.escape(text.format(**units)) for text in COLUMNS.values()]
        rows = choices.rejected(self._named())
        first = next(iter(self.runs.values()))
        heads = "".join(f"<th>{title}</th>" for title in titles)
        body = "".join(
            f'<tr><th scope="row"><span class="swatch style{number}"></span>'
            f"{html.escape(name)}</th>"
            + "".join(f"<td>{_number(found[key])}</td>" for key in COLUMNS)
            + "</tr>"
            for number, (name, found) in enumerate(rows.items())
        )
        said = "".join(f"<p>{html.escape(s)}</p>" for s in choices.verdict(self.runs))
        return (
            f'<p class="quiet small">From {html.escape(choices.told_from(first))} on'
            f"</p><table><thead><tr><th>Run</th>{heads}</tr></thead>"
            f"<tbody>{body}</tbody></table>{said}"
        )

    def template(self) -> pn.Template:
        """Put the page together."""
        page = super().template()
        page.add_panel("floor", self.floor)
        return page


SUBJECT = Subject(
    "disturbances", "Disturbances", DisturbanceChoices, disturbance_charts, LOOK
)


def page() -> pn.Template:
    """Build the page for a new session."""
    return DisturbancePage().template()
