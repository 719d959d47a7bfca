"""From a record to a model: refined instrumental variables (thesis 2.1, 6.3.1).

``sriv`` and ``riv`` fit one output, ``order_search`` tries many structures, and an
``Estimate`` carries its covariance to wherever the model is used.
"""

from nmss_lab.identify.ensemble import pole_draws, step_band, step_response
from nmss_lab.identify.estimate import Estimate, combine, draw
from nmss_lab.identify.experiments import (
    expected_errors,
    experiment,
    multilevel,
    prbs,
    staircase,
)
from nmss_lab.identify.fit import least_squares, riv, sriv
from nmss_lab.identify.noise import fit_noise
from nmss_lab.identify.search import (
    Candidate,
    delay_profile,
    order_search,
    structures,
    table,
)
from nmss_lab.identify.structure import Noise, Orders, Start, stabilised

__all__ = [
    "Candidate",
    "Estimate",
    "Noise",
    "Orders",
    "Start",
    "combine",
    "delay_profile",
    "draw",
    "expected_errors",
    "experiment",
    "fit_noise",
    "least_squares",
    "multilevel",
    "order_search",
    "pole_draws",
    "prbs",
    "riv",
    "sriv",
    "stabilised",
    "staircase",
    "step_band",
    "step_response",
    "structures",
    "table",
]
