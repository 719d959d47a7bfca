"""A Panel page of one slider and one figure: the floor of the stack of the pages.

Run by ``benchmarks/pages.py`` as ``python benchmarks/bare_page.py``; the first line
printed is its address.  ``/panel`` is a page as Panel has it, ``/floor`` one whose
slider is heard at once; ``?points=900`` says how many points the figure has.
"""

import os

os.environ["BOKEH_RESOURCES"] = "server"

import numpy as np
import panel as pn
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure


class Prompt(pn.widgets.FloatSlider):
    """A slider whose changes do not wait 50 ms for others, as the forms' do not."""

    _debounce = 0


def page(kind: type[pn.widgets.FloatSlider]) -> pn.Column:
    """Build the page for a new session."""
    points = int(pn.state.session_args.get("points", [b"900"])[0])
    t = np.linspace(0.0, 1.0, points)
    source = ColumnDataSource({"t": t, "y": np.sin(t)})
    plot = figure(title="0", height=400, sizing_mode="stretch_width")
    plot.line("t", "y", source=source)
    slider = kind(start=0.0, end=20.0, step=0.1)

    def show(event: object) -> None:
        source.data = {"t": t, "y": np.sin(slider.value * t)}
        plot.title.text = str(slider.value)

    slider.param.watch(show, "value")
    return pn.Column(slider, pn.pane.Bokeh(plot), sizing_mode="stretch_width")


def main() -> None:
    """Serve until terminated."""
    built = {
        "panel": lambda: page(pn.widgets.FloatSlider),
        "floor": lambda: page(Prompt),
    }
    server = pn.io.server.get_server(built, port=0, address="127.0.0.1")
    print(f"http://127.0.0.1:{server.port}/", flush=True)
    server.start()
    server.io_loop.start()


if __name__ == "__main__":
    main()
