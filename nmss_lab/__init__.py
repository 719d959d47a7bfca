"""Predictive control structures in the non-minimal state space."""

import logging

from nmss_lab.analysis import (
    LinearLoop,
    Review,
    control_polynomials,
    linear_loop,
    review,
)
from nmss_lab.cases import CASES, Case, case
from nmss_lab.comparison import Score, compare
from nmss_lab.continuous import ContinuousPlant, TransferFunction, difference_model
from nmss_lab.controller import Controller, Limits, Memory, Move, Status
from nmss_lab.convergence import Examination, examine
from nmss_lab.design import Design
from nmss_lab.governor import governor
from nmss_lab.matching import Match, equal_speed, match
from nmss_lab.models import DifferenceModel, LinearPlant, Plant
from nmss_lab.montecarlo import MonteCarlo, monte_carlo, monte_carlo_parts
from nmss_lab.mpc import (
    STRUCTURES,
    disturbance_augmented,
    disturbance_direct,
    forward_path,
    integral_of_error,
    minimal,
    state_weight,
    wang_young,
)
from nmss_lab.pip import lq_gain, pip, pole_gain
from nmss_lab.predict import Horizon
from nmss_lab.predictive import PredictiveController
from nmss_lab.records import Record
from nmss_lab.sdp import sdp_governor, sdp_pip
from nmss_lab.sdp_mpc import Settling, sdp_increments, sdp_integral_of_error
from nmss_lab.simulate import (
    Run,
    Scenario,
    closed_loop,
    closed_loops,
    many_loops,
    samples,
)
from nmss_lab.state_dependent import StateDependentModel
from nmss_lab.tuning import Distance, Goal, Trial, Tuned, pareto, tune
from nmss_lab.uncertainty import (
    EstimatedModels,
    Intervals,
    ParameterCovariance,
    RelativeRanges,
    Sampler,
    realisation,
    uncertainty_bounds,
)
from nmss_lab.weights import Weights

__all__ = [
    "CASES",
    "STRUCTURES",
    "Case",
    "ContinuousPlant",
    "Controller",
    "Design",
    "DifferenceModel",
    "Distance",
    "EstimatedModels",
    "Examination",
    "Goal",
    "Horizon",
    "Intervals",
    "Limits",
    "LinearLoop",
    "LinearPlant",
    "Match",
    "Memory",
    "MonteCarlo",
    "Move",
    "ParameterCovariance",
    "Plant",
    "PredictiveController",
    "Record",
    "RelativeRanges",
    "Review",
    "Run",
    "Sampler",
    "Scenario",
    "Score",
    "Settling",
    "StateDependentModel",
    "Status",
    "TransferFunction",
    "Trial",
    "Tuned",
    "Weights",
    "__version__",
    "case",
    "closed_loop",
    "closed_loops",
    "compare",
    "control_polynomials",
    "difference_model",
    "disturbance_augmented",
    "disturbance_direct",
    "equal_speed",
    "examine",
    "forward_path",
    "governor",
    "integral_of_error",
    "linear_loop",
    "lq_gain",
    "many_loops",
    "match",
    "minimal",
    "monte_carlo",
    "monte_carlo_parts",
    "pareto",
    "pip",
    "pole_gain",
    "realisation",
    "review",
    "samples",
    "sdp_governor",
    "sdp_increments",
    "sdp_integral_of_error",
    "sdp_pip",
    "state_weight",
    "tune",
    "uncertainty_bounds",
    "wang_young",
]

__version__ = "0.1.0"

# Failures are told by each move's status; the log is for who asks for it.
logging.getLogger(__name__).addHandler(logging.NullHandler())
