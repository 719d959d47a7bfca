"""The worked examples as data: plant, designs, scenario, and what is assumed.

``CASES`` maps a name to a function that builds the case; ``case(name)`` calls it.
Sections and equations are those of the thesis (see CITATION.cff) unless a source says
otherwise.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from nmss_lab.continuous import ContinuousPlant, TransferFunction
from nmss_lab.controller import Limits
from nmss_lab.design import Design
from nmss_lab.models import Array, DifferenceModel, LinearPlant
from nmss_lab.mpc import state_weight
from nmss_lab.pip import lq_gain, pole_gain
from nmss_lab.predict import Horizon
from nmss_lab.sdp_mpc import SDP_STRUCTURES, Settling
from nmss_lab.simulate import Scenario
from nmss_lab.state_dependent import StateDependentModel, StateDependentPlant
from nmss_lab.uncertainty import Intervals


@dataclass(frozen=True)
class Zone:
    """Rectangle on a floor plan, in metres from the corner of the plan.

    ``output`` is the number of the output that is its temperature, None where the
    model has none.
    """

    name: str
    place: str
    left: float
    length: float
    output: int | None = None


@dataclass(frozen=True)
class Actuator:
    """Place of an input on the long wall of a floor plan, in metres from its corner."""

    name: str
    at: float
    input: int


@dataclass(frozen=True)
class FloorPlan:
    """Schematic plan of a building whose outputs are the temperatures of zones.

    Parameters
    ----------
    length, width : float
        Metres; a zone is as wide as the building.
    zones : tuple of Zone
    actuators : tuple of Actuator
    outside : int
        Number of the measured disturbance that is the temperature around it.
    full : float
        Deviation from the reference at which a colour is full.
    """

    length: float
    width: float
    zones: tuple[Zone, ...]
    actuators: tuple[Actuator, ...]
    outside: int
    full: float


@dataclass(frozen=True, eq=False)
class Case:
    """A worked example.

    Parameters
    ----------
    name, title : str
    section : str
        Section of the thesis, or of the source.
    source : str
        Where the numbers come from.
    plant : LinearPlant or StateDependentPlant
        Sampled plant; with outputs between the samples if it comes from continuous
        time.
    designs : mapping of str to Design
        Controllers to compare, by a name for display.
    scenario : Scenario
    notes : tuple of str
        What is assumed, what is synthetic, and what differs from the printed text.
    bands : mapping of str to (low, high), optional
        Levels of the outputs that the example calls acceptable; numbers or one entry
        an output.
    continuous : ContinuousPlant, optional
        Plant in continuous time, where there is one.
    covariance : array, optional
        Covariance of the model's parameters, in the order a_1 ... a_na, b_1 ... b_nb.
    plan : FloorPlan, optional
        Where its outputs and inputs are, if it is a building.
    """

    name: str
    title: str
    section: str
    source: str
    plant: LinearPlant | StateDependentPlant
    designs: Mapping[str, Design]
    scenario: Scenario
    notes: tuple[str, ...]
    bands: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    continuous: ContinuousPlant | None = None
    covariance: Array | None = None
    plan: FloorPlan | None = None

    @property
    def model(self) -> DifferenceModel:
        """Model of the first design; of a state-dependent one, sizes and names."""
        model = next(iter(self.designs.values())).model
        return model.wide if isinstance(model, StateDependentModel) else model

    @property
    def equation(self) -> StateDependentModel | None:
        """State-dependent model of the first design, if it is one."""
        model = next(iter(self.designs.values())).model
        return model if isinstance(model, StateDependentModel) else None


def case(name: str) -> Case:
    """Build the case of that name.

    Parameters
    ----------
    name : str
        A key of ``CASES``.

    Raises
    ------
    ValueError
        If there is none.

    Examples
    --------
    >>> case("governor_3_4").section
    '3.4'
    """
    if name not in CASES:
        raise ValueError(f'case "{name}": expected one of {", ".join(CASES)}')
    return CASES[name]()


AS_PRINTED = {"anti_windup": False}
"""The thesis sums the error on while the input is at a limit."""


def predictive(design: Design, *structures: str) -> dict[str, Design]:
    """Design with each of the structures, all else equal."""
    return {name: dataclasses.replace(design, structure=name) for name in structures}


def piecewise(samples: int, *changes: tuple[int, Any]) -> Array:
    """Series (samples, channels) that takes a value from each given sample on.

    Each change is (first sample, value); zero before the first.

    Examples
    --------
    >>> piecewise(5, (1, 2.0), (4, -1.0)).ravel()
    array([ 0.,  2.,  2.,  2., -1.])
    """
    series = np.zeros((samples, np.size(changes[0][1])))
    for first, value in changes:
        series[first:] = value
    return series


# Chapter 3


def governor_3_4() -> Case:
    """Govern the reference of a fast PIP loop."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    limits = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5))
    K = pole_gain(model, [0.0, 0.0, 0.2, 0.2])
    governed = Design(
        "governor", model, Horizon(10, 10), limits=limits, options={"K": K}
    )
    mpc = Design("wang_young", model, Horizon(20, 5), 1 / 20, 1 / 5, limits)
    integral = Design(
        "integral_of_error", model, Horizon(20, 5), 1 / 20, 1 / 5, limits, "zero"
    )
    return Case(
        name="governor_3_4",
        title="Reference governor over a marginally stable plant",
        section="3.4",
        source="Plant of (6.10), poles, limits and set-points of section 3.4",
        plant=model.plant(),
        designs={
            "governor": governed,
            "pip": Design("pip", model, limits=limits, options={"K": K}),
            "integral_of_error": integral,
            **predictive(mpc, "wang_young", "forward_path", "minimal"),
        },
        scenario=Scenario(piecewise(60, (5, 5.0), (31, -5.0))),
        notes=(
            "The first input coefficient is -1, as in (6.10); -0.5 is printed in 3.4, "
            "but the printed gain stabilises the plant only with -1.",
            "The reference is not previewed: the governor chooses w_k at sample k.",
            "PIP is the incremental law (3.13) with its two corrected branches, so "
            "nothing winds up.",
            "The steady-state gain is 10/3, so inputs up to 2 hold outputs up to "
            "6.67 only.",
            "The predictive designs, not part of this section, take the horizons and "
            "weights of 6.3.2.",
        ),
    )


# Chapter 4


def double_integrator_4_4_1() -> Case:
    """Disturbance rejection on a double integrator."""
    model = DifferenceModel([-2.0, 1.0], [0.5, 0.5])
    limits = Limits(u=(-10.0, 10.0), du=(-7.0, 7.0))
    design = Design(
        "integral_of_error", model, Horizon(5, 3), 5 / 15, 1 / 3, limits, "zero"
    )
    mpc = dataclasses.replace(design, Q=1.0, R=1.0, reference="held")
    design = dataclasses.replace(design, options=AS_PRINTED)
    K = lq_gain(model, 5 / 15, 1 / 3)
    pip = Design("pip", model, limits=limits, options={"K": K})
    return Case(
        name="double_integrator_4_4_1",
        title="Double integrator with input and output disturbances",
        section="4.4.1",
        source="Section 4.4.1",
        plant=model.plant(),
        designs={
            "integral_of_error": design,
            **predictive(mpc, "wang_young", "forward_path", "minimal"),
            "pip": pip,
        },
        scenario=Scenario(
            np.zeros(41),
            output_disturbance=piecewise(41, (5, 15.0)),
            input_disturbance=piecewise(41, (20, -5.0)),
        ),
        notes=(
            "The output disturbance of 15 is added to the output, the input "
            "disturbance of -5 to the plant's input; no controller knows of either.",
            "Q = 5/15 is printed as weight over horizon although Np = 5; the value is "
            "used as printed.",
            "Inputs of the forward path's internal model are undisturbed: its hidden "
            "double integrator is never damped, and it cannot hold the output.",
            "The printed example has one structure; weights of the others, and the LQ "
            "gain of PIP, are our choice.",
            "There is no governor here: its predictions know nothing of the input "
            "disturbance and would hold the reference back for ever.",
        ),
    )


def ifac93_plant(
    T1: float = 5.0,
    T2: float = 0.4,
    w0: float = 5.0,
    zeta: float = 0.3,
    K: float = 1.0,
) -> ContinuousPlant:
    """Build the IFAC'93 benchmark plant of 7th order, (4.22).

    Parameters
    ----------
    T1, T2 : float
        Time constants of the slow pole and of the right-hand zero, in seconds.
    w0, zeta : float
        Frequency in rad/s and damping of the resonance.
    K : float
        Steady-state gain.
    """
    fast = 15.0
    num = K * w0**2 * fast**2 * np.array([-T2, 1.0])
    den: Array = np.ones(1)
    for factor in (
        [1.0, 2.0 * zeta * w0, w0**2],
        [T1, 1.0],
        [1.0, 2.0 * 0.6 * fast, fast**2],
        [1 / 8, 1.0],
        [1 / 12, 1.0],
    ):
        den = np.polymul(den, factor)
    return ContinuousPlant([[TransferFunction(num.tolist(), den.tolist())]])


STRESS_LEVELS: dict[int, dict[str, float]] = {
    1: {"T1": 0.20, "T2": 0.05, "w0": 1.50, "zeta": 0.10, "K": 0.0},
    2: {"T1": 0.30, "T2": 0.10, "w0": 2.50, "zeta": 0.15, "K": 0.15},
    3: {"T1": 0.30, "T2": 0.15, "w0": 3.00, "zeta": 0.15, "K": 0.50},
}
"""Largest deviations of the IFAC'93 plant's parameters, Table 4.1."""


def stress(
    level: int, corners: bool = False, dt: float = 0.5, substeps: int = 1
) -> Intervals:
    """Parameters of the IFAC'93 plant within a stress level (Table 4.1).

    The corners, 32, come in the order of ``itertools.product`` on T1, T2, w0, zeta, K,
    the low side first.  Level 1 leaves K alone, so that its plants come in pairs.

    Parameters
    ----------
    level : int
        1, 2 or 3.
    corners : bool
        Whether to take the corners instead of uniform draws.
    dt, substeps : float, int
        Sampling of the plants, see ``ContinuousPlant.sampled``.

    Raises
    ------
    ValueError
        If there is no such level.
    """
    if level not in STRESS_LEVELS:
        raise ValueError(f"level = {level}: expected 1, 2 or 3")
    nominal = {"T1": 5.0, "T2": 0.4, "w0": 5.0, "zeta": 0.3, "K": 1.0}
    around = {
        name: (value - STRESS_LEVELS[level][name], value + STRESS_LEVELS[level][name])
        for name, value in nominal.items()
    }
    build = functools.partial(_sampled_ifac93, dt, substeps)
    return Intervals(build, around, corners)


def _sampled_ifac93(dt: float, substeps: int, **parameters: float) -> LinearPlant:
    return ifac93_plant(**parameters).sampled(dt, substeps)


def square_wave(samples: int, half_period: int) -> Array:
    """Series (samples, 1) that is 1, then -1, and so on, ``half_period`` each."""
    wave: Array = 1.0 - 2.0 * (np.arange(samples) // half_period % 2)
    return wave[:, None]


IFAC93_BANDS = {"wanted": (-1.2, 1.2), "allowed": (-1.5, 1.5)}
IFAC93_SOURCE = (
    "Plant (4.22) of the IFAC'93 benchmark (Whidborne et al., 1995), model (4.23), "
    "Table 4.1"
)


def ifac93_model() -> DifferenceModel:
    """Model (4.23), sampled at 0.5 s."""
    return DifferenceModel([-0.9055], [0.0, 0.0946], dt=0.5)


def ifac93_4_4_2() -> Case:
    """IFAC'93 benchmark with the sum of the error in the state."""
    model, continuous = ifac93_model(), ifac93_plant()
    limits = Limits(u=(-5.0, 5.0))
    design = Design(
        "integral_of_error", model, Horizon(50, 10), 1.0, 0.1, limits, "zero"
    )
    mpc = dataclasses.replace(design, Q=0.085, reference="held")
    design = dataclasses.replace(design, options=AS_PRINTED)
    K = lq_gain(model, 1.0, 0.1)
    return Case(
        name="ifac93_4_4_2",
        title="IFAC'93 benchmark, sum of the error in the state",
        section="4.4.2",
        source=IFAC93_SOURCE,
        plant=continuous.sampled(0.5, substeps=50),
        designs={
            "integral_of_error": design,
            **predictive(mpc, "wang_young", "forward_path", "minimal"),
            "pip": Design("pip", model, limits=limits, options={"K": K}),
            "governor": Design(
                "governor", model, Horizon(15, 15), limits=limits, options={"K": K}
            ),
        },
        scenario=Scenario(square_wave(120, 20)),
        notes=(
            "The plant is of 7th order, the model of first order with a dead time: "
            "model and plant differ even nominally.",
            "The reference enters the integral-of-error design through the sum of the "
            "error alone (S = 0); only this reading gives figures 4.3 and 4.4.",
            "The weights of Wang and Young's design are not printed; 0.085 and 0.1 "
            "settle in a similar time.",
            "The LQ gain of PIP and governor, for the same weights, is our addition.",
        ),
        bands=IFAC93_BANDS,
        continuous=continuous,
    )


# Chapter 5

SHELL_A = [
    np.diag([-1.6637, -2.4418, -1.9553]),
    np.diag([0.6918, 1.9864, 1.2334]),
    np.diag([0.0, -0.5383, -0.2473]),
]
SHELL_B = [
    [[0.0, 0.0, 0.0], [0.0, 0.4173, 0.5851], [0.0, 0.0, 3.9167]],
    [[0.1232, 0.0, 0.1789], [0.9853, -0.2036, -0.0301], [0.9993, 0.8873, -6.0118]],
    [
        [0.5079, 0.2737, 0.7375],
        [-1.6010, -0.4722, -1.1641],
        [-1.0690, -0.6085, 2.3036],
    ],
    [[-0.5173, -0.2241, -0.7511], [0.6493, 0.2940, 0.6520], [0.1557, -0.2109, 0.0]],
    [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0492, 0.1303, 0.0]],
]
SHELL_DEAD_TIMES = (2, 1, 1)
"""Samples before any input reaches each output of (5.7)."""


def shell_model() -> DifferenceModel:
    """Shell fractionator as the difference equation (5.7)."""
    return DifferenceModel(np.array(SHELL_A), np.array(SHELL_B), dt=10.0)


def shell_desired(samples: int, output: int) -> Array:
    """Desired outputs (samples, 3) for a unit step of one reference, (5.8).

    The response of first order with its pole at 0.7 starts after the dead time of the
    output; the other outputs stay at zero.
    """
    desired = np.zeros((samples, 3))
    k = np.arange(samples - SHELL_DEAD_TIMES[output] + 1)
    desired[samples - len(k) :, output] = 1.0 - 0.7**k
    return desired


def shell_step(samples: int, output: int) -> Scenario:
    """Scenario with a unit step of one reference from sample 1 on.

    A controller that reads r_{k+1} acts at sample 0.
    """
    return Scenario(piecewise(samples, (1, np.eye(3)[output])))


def shell_weights(name: str) -> tuple[Any, Any, Any, Any]:
    """Give the printed weights w_y, w_u-, w_z, w_u of row "a" or "b" of Table 5.2.

    Entry (2, 2) of w_u in row b is printed as 0.005; 0.2575 gives the printed table.
    """
    rows: dict[str, tuple[Any, Any, Any, Any]] = {
        "a": (
            [
                [0.9873, 0.1308, 0.0097],
                [0.1308, 0.4687, 0.0433],
                [0.0097, 0.0433, 0.8913],
            ],
            [[0.4785, 0.5, 0.5], [0.5, 0.3093, 0.005], [0.5, 0.005, 0.1895]],
            [
                [0.0792, 0.0167, 0.0050],
                [0.0167, 0.0327, 0.0140],
                [0.0050, 0.0140, 0.0758],
            ],
            [
                [0.9705, 0.0648, 0.4984],
                [0.0648, 0.9987, 0.0050],
                [0.4984, 0.0050, 0.0154],
            ],
        ),
        "b": (
            [0.2164, 0.2940, 1.0],
            [0.01, 0.01, 0.01],
            [
                [0.0345, 0.0122, 0.0050],
                [0.0122, 0.0583, 0.0050],
                [0.0050, 0.0050, 0.1076],
            ],
            [0.005, 0.2575, 0.01],
        ),
    }
    return rows[name]


SHELL_WANG = (
    [[0.0642, 0.0050, 0.0612], [0.0050, 0.2921, 0.0050], [0.0612, 0.0050, 0.2344]],
    [[1.8544, 1.7499, 0.6671], [1.7499, 1.6666, 1.0602], [0.6671, 1.0602, 6.1138]],
)
"""Q and R of Wang and Young's design, Q(3, 2) corrected to 0.0050."""

SHELL_MINIMAL = (
    [[0.0664, 0.0050, 0.0634], [0.0050, 0.3033, 0.0050], [0.0634, 0.0050, 0.2420]],
    [[1.9229, 1.8211, 0.7260], [1.8211, 1.7400, 1.1332], [0.7260, 1.1332, 6.4104]],
)
"""Q and R of the minimal design, Q(3, 2) corrected to 0.0050."""


def shell_designs() -> dict[str, Design]:
    """Four designs of Table 5.2, and the forward path with Wang and Young's weights."""
    model, horizon = shell_model(), Horizon(10, 5)
    designs = {}
    for row, name in (("a", "integral_of_error"), ("b", "integral_of_error_b")):
        w_y, w_past_u, w_z, w_u = shell_weights(row)
        Q = state_weight(model, np.array(w_y), np.array(w_past_u), np.array(w_z))
        designs[name] = Design(
            "integral_of_error", model, horizon, Q, np.array(w_u), reference="next"
        )
    Q, R = map(np.array, SHELL_WANG)
    wang = Design("wang_young", model, horizon, Q, R, reference="next")
    Q, R = map(np.array, SHELL_MINIMAL)
    designs |= predictive(wang, "wang_young", "forward_path")
    designs["minimal"] = dataclasses.replace(wang, structure="minimal", Q=Q, R=R)
    return designs


def shell_5_3_2() -> Case:
    """Shell heavy oil fractionator with the designed response of Table 5.2."""
    model = shell_model()
    steps = piecewise(
        90, (1, [1.0, 0.0, 0.0]), (31, [1.0, 1.0, 0.0]), (61, [1.0, 1.0, 1.0])
    )
    return Case(
        name="shell_5_3_2",
        title="Shell heavy oil fractionator, designed response",
        section="5.3.2",
        source="Model (5.7), weights of 5.3.2.2, Table 5.2",
        plant=model.plant(),
        designs=shell_designs(),
        scenario=Scenario(steps),
        notes=(
            "The plant is the difference equation (5.7) itself, without limits. Its "
            "third output is not the third output of Table 5.1.",
            "The controllers know r_{k+1} one sample ahead; this reading gives Table "
            "5.2.",
            "Printed weights with corrections: Q(3,2) of the Wang-Young and minimal "
            "designs is 0.0050, and w_u(2,2) of row b is 0.2575.",
            "Some printed weights are indefinite; the condensed Hessian is positive "
            "definite all the same.",
            "The three references step one after the other; Table 5.2 has a separate "
            "run for each.",
        ),
    )


# Chapter 6

MARGINAL_COVARIANCE = 1e-4 * np.array(
    [
        [0.4, -0.33, -4.2, 7.9],
        [-0.33, 0.38, -1.2, -2.9],
        [-4.2, -1.2, 410.0, -380.0],
        [7.9, -2.9, -380.0, 440.0],
    ]
)
"""P* of section 6.3.2, order a_1, a_2, b_1, b_2."""


def pulse(samples: int, first: int, length: int, height: float) -> Array:
    """Series (samples, 1) that is ``height`` for ``length`` samples and zero else."""
    return piecewise(samples, (first, height), (first + length, 0.0))


def marginally_stable_6_3_2() -> Case:
    """Marginally stable plant: feedback against forward path."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    design = Design("wang_young", model, Horizon(20, 5), 1 / 20, 1 / 5)
    K = pole_gain(model, [0.0, 0.5, 0.4 + 0.3j, 0.4 - 0.3j])
    return Case(
        name="marginally_stable_6_3_2",
        title="Marginally stable plant, feedback and forward path",
        section="6.3.2",
        source="Plant (6.10), horizons, weights and P* of section 6.3.2",
        plant=model.plant(),
        designs={
            **predictive(design, "wang_young", "forward_path", "minimal"),
            "integral_of_error": dataclasses.replace(
                design, structure="integral_of_error", reference="zero"
            ),
            "pip": Design("pip", model, options={"K": K}),
            "pip_forward": Design("pip", model, options={"K": K, "path": "forward"}),
        },
        scenario=Scenario(
            np.ones(150),
            input_disturbance=pulse(150, 20, 30, 0.2),
            output_disturbance=pulse(150, 80, 20, -0.5),
            seen=True,
        ),
        notes=(
            "The internal model of the forward path sees the disturbed input: figure "
            "6.5 comes out only so. If it does not, its hidden modes on the unit "
            "circle make the loop oscillate for ever after the input disturbance.",
            "The reference is held at r_k.",
            "P* belongs to a_1, a_2, b_1, b_2 in this order; it was scaled up on "
            "purpose.",
            "Integral-of-error design with the same numbers as weights, and PIP with "
            "poles near the nominal ones, are our additions.",
        ),
        covariance=MARGINAL_COVARIANCE,
    )


FORWARD_OPTIMISED = (
    [0.4394, 0.1545, 0.1465, 0.2611, 0.4041, 0.4914, 0.5561, 0.6027, 0.6354, 0.6572],
    [0.001, 0.9284, 0.9072, 0.8042, 0.6891],
)
"""Diagonals of Q and R along the horizons, section 6.3.3."""


def ifac93_6_3_3() -> Case:
    """IFAC'93 benchmark: feedback, forward path, and the optimised forward path."""
    model, continuous = ifac93_model(), ifac93_plant()
    limits = Limits(u=(-5.0, 5.0))
    design = Design("wang_young", model, Horizon(50, 10), 10 / 50, 1 / 10, limits)
    Q, R = map(np.array, FORWARD_OPTIMISED)
    tuned = dataclasses.replace(design, horizon=Horizon(10, 5), Q=Q, R=R)
    integral = Design(
        "integral_of_error", model, Horizon(50, 10), 1.0, 0.1, limits, "zero"
    )
    return Case(
        name="ifac93_6_3_3",
        title="IFAC'93 benchmark, feedback and forward path",
        section="6.3.3",
        source=IFAC93_SOURCE + ", weights of section 6.3.3",
        plant=continuous.sampled(0.5, substeps=50),
        designs={
            **predictive(design, "wang_young", "forward_path", "minimal"),
            "forward_path_optimised": predictive(tuned, "forward_path")["forward_path"],
            "feedback_optimised": tuned,
            "integral_of_error": integral,
        },
        scenario=Scenario(square_wave(120, 20)),
        notes=(
            "The reference is held at r_k.",
            "The optimised weights, 10 for Q and 5 for R, belong to Np = 10 and "
            "Nc = 5; they were found for the forward path.",
            "Nothing disturbs the input, so it does not matter what the internal model "
            "sees.",
            "The integral-of-error design is the one of 4.4.2.",
        ),
        bands=IFAC93_BANDS,
        continuous=continuous,
    )


GASIFIER_OPERATING_POINT = np.array([0.9, 17.42, 8.55, 2.7])
"""WCHR, WAIR, WCOL, WSTM in kg/s at 100 % load (Dixon and Pike, 2005)."""


def gasifier_model() -> DifferenceModel:
    """Gasifier of (6.12) in deviations from 100 % load, sampled at 1 s."""
    a = [
        np.diag([-1.8225, -1.7652, -0.8469, -0.9984]),
        np.diag([0.8298, 0.7663, 0.1195, 0.0]),
        np.diag([0.0, 0.0, -0.0268, 0.0]),
    ]
    b = [
        [
            [0.0135, -8.3538, 3.0317, -5.7507],
            [-0.0773, -0.1199, 0.0734, -0.1603],
            [0.0001, 0.0271, 0.0066, 0.0434],
            [0.0174, 0.0405, -0.0371, -0.0139],
        ],
        [
            [0.0, 7.4359, -2.4752, 7.0412],
            [0.0, 0.0, 0.0, 0.0],
            [0.0, -0.0065, 0.0, -0.0079],
            [0.0, 0.0, 0.0, 0.0],
        ],
    ]
    outputs, inputs = (
        ("CVGAS", "MASS", "PGAS", "TGAS"),
        ("WCHR", "WAIR", "WCOL", "WSTM"),
    )
    units = {"CVGAS": "kJ/kg", "MASS": "kg", "PGAS": "bar", "TGAS": "K"}
    units |= dict.fromkeys(inputs, "kg/s")
    return DifferenceModel(
        np.array(a), np.array(b), y_names=outputs, u_names=inputs, units=units
    )


def gasifier_6_3_4() -> Case:
    """Build the gasifier with its pressure swinging."""
    model = gasifier_model()
    low, high = np.zeros(4), np.array([3.5, 20.0, 10.0, 6.0])
    rate = np.array([0.2, 1.0, 0.2, 1.0])
    limits = Limits(
        u=(low - GASIFIER_OPERATING_POINT, high - GASIFIER_OPERATING_POINT),
        du=(-rate, rate),
    )
    Q, R = np.array([0.25, 0.1, 1000.0, 10.0]), np.array([1.0, 10.0, 0.1, 10.0])
    design = Design("wang_young", model, Horizon(60, 7), Q, R, limits)
    integral = dataclasses.replace(
        design,
        structure="integral_of_error",
        horizon=Horizon(80, 7),
        Q=state_weight(model, Q, 0.0, 0.01 * Q),
        reference="zero",
    )
    swing = 0.1 * np.sin(2.0 * np.pi * np.arange(300) / 25.0)
    return Case(
        name="gasifier_6_3_4",
        title="Gasifier model with a swinging pressure",
        section="6.3.4",
        source="Model (6.12), weights and Table 6.2; operating point from the public "
        "benchmark (Dixon and Pike, 2005)",
        plant=model.plant(),
        designs={
            **predictive(design, "wang_young", "forward_path", "minimal"),
            "wang_young_printed": dataclasses.replace(design, horizon=Horizon(20, 7)),
            "integral_of_error": integral,
        },
        scenario=Scenario(
            np.zeros((300, 4)), output_disturbance=np.outer(swing, [0.0, 0.0, 1.0, 0.0])
        ),
        notes=(
            "The order is y = CVGAS, MASS, PGAS, TGAS and u = WCHR, WAIR, WCOL, WSTM: "
            "signs and sizes of the gains, weights and Table 6.2 fit it, the printed "
            "order does not.",
            "The plant is the linear model (6.12); the non-linear benchmark is not "
            "public, so figures 6.8 to 6.11 and Table 6.3 cannot be checked.",
            "The disturbance is synthetic: a sine of 0.1 bar and 25 s added to the "
            "pressure. The benchmark disturbs the sink pressure.",
            "With the printed Np = 20 and Nc = 7 the loop without limits is unstable "
            "on this model, which has a transmission zero at 1.038; Np = 60 is used, "
            "and the printed horizons are kept as a design of their own.",
            "Limits of Table 6.2 are levels; the signals here are deviations from the "
            "operating point at 100 % load.",
            "The integral-of-error design, with Np = 80, is our addition.",
        ),
        bands={
            "allowed": (
                np.array([-10.0, -500.0, -0.1, -1.0]),
                np.array([10.0, 500.0, 0.1, 1.0]),
            )
        },
    )


# Chapter 7


def measured_disturbance_7_4_1() -> Case:
    """Build the plant with a measured disturbance, used and not used."""
    model = DifferenceModel([-1.4, 0.45], [0.3, -0.27], [0.4, -0.2])
    design = Design("disturbance_direct", model, Horizon(10, 3), 1.0, 0.1)
    integral = dataclasses.replace(
        design,
        structure="integral_of_error",
        Q=np.array([1.0, 0.0, 0.0, 0.1]),
        R=0.01,
        reference="zero",
    )
    noise = 0.3 * np.random.default_rng(7).standard_normal((100, 1))
    return Case(
        name="measured_disturbance_7_4_1",
        title="Measured disturbance, used and not used",
        section="7.4.1",
        source="Plant and disturbance of section 7.4.1",
        plant=model.plant(),
        designs={
            **predictive(
                design,
                "disturbance_direct",
                "disturbance_augmented",
                "wang_young",
                "forward_path",
                "minimal",
            ),
            "integral_of_error": integral,
        },
        scenario=Scenario(
            piecewise(100, (10, 1.0)), v=noise + piecewise(100, (50, 0.5))
        ),
        notes=(
            "v_k is measured before u_k is computed, and held over the horizon.",
            "The disturbance is white noise of standard deviation 0.3, from a fixed "
            "seed, with its mean at 0.5 from sample 50 on; the printed series is not "
            "known.",
            "Horizons, weights and length are not printed; these are our choice.",
            "wang_young, forward_path, minimal and integral_of_error ignore v.",
            "A and B share the factor 1 - 0.9 z^-1: one closed-loop pole stays at 0.9.",
            "Written so that the present change of v counts once, direct and augmented "
            "form are the same controller.",
        ),
    )


def temperature_model(airflow_unit: float = 100.0) -> DifferenceModel:
    """Temperature installation of 7.4.2, sampled every 6 minutes.

    Parameters
    ----------
    airflow_unit : float
        What one unit of u1 is, in m3/h: the printed B_1 fits 100, not 1.
    """
    unit = "m3/h" if airflow_unit == 1.0 else f"{airflow_unit:g} m3/h"
    return DifferenceModel(
        np.diag([-0.9799, -0.9788])[None],
        np.array(
            [
                [[-0.0011, 0.0], [-0.0009, 0.0]],
                [[0.0, 0.0596], [0.0, 0.1201]],
                [[0.0, -0.0517], [0.0, -0.1105]],
            ]
        ),
        np.array([[[0.0], [0.0]], [[0.8952], [0.8288]], [[-0.8818], [-0.8162]]]),
        dt=360.0,
        y_names=("group I", "group II"),
        u_names=("ventilation", "inlet"),
        v_names=("surroundings",),
        units={
            "group I": "degC",
            "group II": "degC",
            "ventilation": unit,
            "inlet": "degC",
            "surroundings": "degC",
        },
    )


def surrounding_temperature(samples: int) -> Array:
    """Synthetic temperature (samples, 1) around the installation, one every 6 minutes.

    A day cycle of 1.5 degC, a drift of 2 degC over 150 h, and a door that opens at
    hour 55: 2 degC colder within 48 minutes, recovering with a time constant of 2 h.
    """
    t = 0.1 * np.arange(samples)
    day = 1.5 * np.sin(2.0 * np.pi * (t - 9.0) / 24.0)
    drift = 2.0 * np.sin(2.0 * np.pi * (t - 20.0) / 150.0)
    falling = -2.0 * np.clip(t - 55.0, 0.0, 0.8) / 0.8
    door = falling * np.exp(-np.maximum(t - 55.8, 0.0) / 2.0)
    series: Array = 22.5 + day + drift + door
    return series[:, None]


def temperature_scenario(
    samples: int, ventilation: float = 16.0, inlet: float = 23.2
) -> Scenario:
    """Scenario at 23 degC, from rest with given inputs and the first disturbance."""
    v = surrounding_temperature(samples)
    start = np.array([ventilation, inlet])
    return Scenario(np.full((samples, 2), 23.0), v=v, u0=start, v0=v[0])


TEMPERATURE_PLAN = FloorPlan(
    length=12.0,
    width=4.0,
    zones=(
        Zone("Group I", "front wall", 0.0, 4.0, 0),
        Zone("Group III", "middle", 4.0, 4.0),
        Zone("Group II", "back wall", 8.0, 4.0, 1),
    ),
    actuators=(Actuator("Ventilation", 2.0, 0), Actuator("Inlet air", 8.0, 1)),
    outside=0,
    full=1.0,
)


def temperature_7_4_2() -> Case:
    """Build the temperature installation with synthetic surroundings."""
    model = temperature_model()
    limits = Limits(
        u=(np.array([10.0, 15.0]), np.array([25.0, 27.0])),
        du=(np.array([-3.5, -3.0]), np.array([3.5, 1.0])),
    )
    design = Design("disturbance_direct", model, Horizon(10, 3), 1.0, 1.0, limits)
    Q = state_weight(model, 1.0, 0.0, 0.1)
    integral = dataclasses.replace(
        design, structure="integral_of_error", Q=Q, R=0.1, reference="zero"
    )
    return Case(
        name="temperature_7_4_2",
        title="Temperature installation, synthetic surroundings",
        section="7.4.2",
        source="Model, horizons, weights and Table 7.4 of section 7.4.2",
        plant=model.plant(),
        designs={
            **predictive(
                design,
                "disturbance_direct",
                "disturbance_augmented",
                "wang_young",
                "forward_path",
                "minimal",
            ),
            "integral_of_error": integral,
        },
        scenario=temperature_scenario(800),
        notes=(
            "SYNTHETIC: the surrounding temperature is made up (day cycle, slow drift, "
            "and a door that opens at hour 55); the measured series is not public.",
            "The plant is the pair of group models; the 36 sensor models of the thesis "
            "are not public.",
            "The ventilation is in units of 100 m3/h, which fits the printed B_1; "
            "Table 7.4 then reads 10 to 25, rate 3.5.",
            "Both groups can be held at 23 degC only for surroundings between about "
            "21.3 and 23.1 degC.",
            "The loop starts at the equilibrium for the first surrounding temperature.",
            "The floor plan is schematic. From the thesis: 12 m by 4 m, in a large "
            "room, sensors of group I near the front wall, of group II near the back "
            "wall, and between them those of group III, which is not controlled. "
            "Assumed: that front and back are the short walls, that zones are equal, "
            "and where ventilation and inlet are.",
            "wang_young, forward_path, minimal and integral_of_error ignore the "
            "measured disturbance; the last is our addition.",
        ),
        bands={"within 1 degC": (22.0, 24.0)},
        plan=TEMPERATURE_PLAN,
    )


# Public cases

GRAVITY = 981.0


def quadruple_tank_plant(minimum_phase: bool = True) -> ContinuousPlant:
    """Build the linearised quadruple tank: levels in V of the sensors, pumps in V.

    At the operating points P- (minimum phase) and P+ of Johansson (2000).
    """
    area = np.array([28.0, 32.0, 28.0, 32.0])
    outlet = np.array([0.071, 0.057, 0.071, 0.057])
    sensor = 0.5
    if minimum_phase:
        level, flow, share = (12.4, 12.7, 1.8, 1.4), (3.33, 3.35), (0.70, 0.60)
    else:
        level, flow, share = (12.6, 13.0, 4.8, 4.9), (3.14, 3.29), (0.43, 0.34)
    T = area / outlet * np.sqrt(2.0 * np.array(level) / GRAVITY)
    channels = []
    for i, (own, above) in enumerate(((0, 2), (1, 3))):
        into = sensor * T[own] / area[own]
        direct = TransferFunction([share[i] * flow[i] * into], [T[own], 1.0])
        other = 1 - i
        upper = TransferFunction(
            [(1.0 - share[other]) * flow[other] * into],
            np.polymul([T[own], 1.0], [T[above], 1.0]).tolist(),
        )
        channels.append([direct, upper] if i == 0 else [upper, direct])
    names = ("level 1", "level 2"), ("pump 1", "pump 2")
    units = dict.fromkeys((*names[0], *names[1]), "V")
    return ContinuousPlant(channels, y_names=names[0], u_names=names[1], units=units)


def _quadruple_tank(minimum_phase: bool) -> Case:
    continuous = quadruple_tank_plant(minimum_phase)
    dt, horizon = (5.0, Horizon(40, 5)) if minimum_phase else (20.0, Horizon(50, 5))
    model = continuous.difference_model(dt)
    pump = np.array([3.0, 3.0]) if minimum_phase else np.array([3.15, 3.15])
    limits = Limits(u=(-pump, 10.0 - pump))
    design = Design("wang_young", model, horizon, 1.0, 0.1, limits)
    integral = dataclasses.replace(
        design,
        structure="integral_of_error",
        Q=state_weight(model, 1.0, 0.0, 0.1 if minimum_phase else 0.01),
        R=0.1,
        reference="zero",
    )
    length = 160 if minimum_phase else 200
    return Case(
        name=f"quadruple_tank_{'minus' if minimum_phase else 'plus'}",
        title="Quadruple tank, "
        + ("minimum phase" if minimum_phase else "non-minimum phase"),
        section="Johansson (2000)",
        source="K. H. Johansson, The quadruple-tank process, IEEE Trans. Control "
        "Systems Technology 8(3), 2000: parameters and operating point "
        + ("P-" if minimum_phase else "P+"),
        plant=continuous.sampled(dt, substeps=5),
        designs={
            **predictive(design, "wang_young", "forward_path", "minimal"),
            "integral_of_error": integral,
        },
        scenario=Scenario(
            piecewise(length, (2, [0.5, 0.0]), (length // 2, [0.5, 0.5])),
            input_disturbance=piecewise(length, (3 * length // 4, [0.3, 0.0])),
        ),
        notes=(
            "Signals are deviations from the operating point; pumps run from 0 to "
            "10 V.",
            "The plant is the linearisation. Each level sees the pump of the tank "
            "above it with that pump's own flow constant.",
            "Horizons, weights and scenario are our choice; the reference is held at "
            "r_k, the input disturbance is unknown to every controller.",
        ),
        continuous=continuous,
    )


def quadruple_tank_minus() -> Case:
    """Build the quadruple tank in its minimum-phase setting."""
    return _quadruple_tank(minimum_phase=True)


def quadruple_tank_plus() -> Case:
    """Build the quadruple tank in its non-minimum-phase setting."""
    return _quadruple_tank(minimum_phase=False)


def wood_berry_plant() -> ContinuousPlant:
    """Build the Wood-Berry column in seconds: compositions, reflux and steam; feed."""

    def channel(gain: float, minutes: float, delay: float) -> TransferFunction:
        return TransferFunction([gain], [60.0 * minutes, 1.0], delay=60.0 * delay)

    return ContinuousPlant(
        [
            [channel(12.8, 16.7, 1.0), channel(-18.9, 21.0, 3.0)],
            [channel(6.6, 10.9, 7.0), channel(-19.4, 14.4, 3.0)],
        ],
        [[channel(3.8, 14.9, 8.1)], [channel(4.9, 13.2, 3.4)]],
        y_names=("distillate", "bottoms"),
        u_names=("reflux", "steam"),
        v_names=("feed",),
        units={
            "distillate": "mol %",
            "bottoms": "mol %",
            "reflux": "lb/min",
            "steam": "lb/min",
            "feed": "lb/min",
        },
    )


def wood_berry() -> Case:
    """Build the distillation column with dead times and a measured feed."""
    continuous = wood_berry_plant()
    model = continuous.difference_model(60.0)
    limits = Limits(u=(-0.5, 0.5), du=(-0.1, 0.1))
    design = Design("wang_young", model, Horizon(40, 5), 1.0, 10.0, limits)
    integral = dataclasses.replace(
        design,
        structure="integral_of_error",
        Q=state_weight(model, 1.0, 0.0, 0.05),
        R=30.0,
        reference="zero",
    )
    return Case(
        name="wood_berry",
        title="Wood-Berry distillation column",
        section="Wood and Berry (1973)",
        source="R. K. Wood and M. W. Berry, Terminal composition control of a binary "
        "distillation column, Chem. Eng. Science 28, 1973: transfer functions",
        plant=continuous.sampled(60.0, substeps=4),
        designs={
            **predictive(
                design, "wang_young", "disturbance_direct", "forward_path", "minimal"
            ),
            "integral_of_error": integral,
        },
        scenario=Scenario(
            piecewise(200, (5, [1.0, 0.0]), (70, [1.0, 1.0])),
            v=piecewise(200, (135, 0.3)),
        ),
        notes=(
            "Signals are deviations from the operating point; times in the source are "
            "minutes.",
            "The feed is measured; only disturbance_direct uses it.",
            "Limits, horizons, weights and scenario are our choice; the reference is "
            "held at r_k.",
        ),
        continuous=continuous,
    )


# Identified models


def model_case(
    model: DifferenceModel, covariance: Array | None = None, name: str = "your_model"
) -> Case:
    """Case that tries controllers on a model of one's own, as on a perfect plant.

    Horizons and weights follow from the model's slowest pole, its delay and its gains.

    Parameters
    ----------
    model : DifferenceModel
        Stable, with one output.
    covariance : array, optional
        Of its parameters.
    name : str

    Raises
    ------
    ValueError
        If the model has several outputs, is not stable, or no input has a gain.
    """
    slowest = float(np.abs(model.poles()).max())
    gains = np.abs(model.steady_state_gain()).ravel()
    if model.n_y > 1 or slowest >= 1.0 or not gains.max() > 0.0:
        raise ValueError(
            f"model with {model.n_y} outputs, largest pole {slowest:.4g} and gains "
            f"{gains}: expected one output, a stable model and a gain"
        )
    tau = float(np.clip(-1.0 / np.log(max(slowest, 0.1)), 1.0, 25.0))
    Np = int(np.clip(model.nb + 3.0 * tau, 8, 80))
    R = np.diag(0.1 * tau * np.maximum(gains, 1e-3 * gains.max()) ** 2)
    design = Design("wang_young", model, Horizon(Np, int(np.clip(Np // 4, 2, 10))), R=R)
    names = ["wang_young", *(["disturbance_direct"] * bool(model.n_v)), "minimal"]
    integral = dataclasses.replace(
        design,
        structure="integral_of_error",
        Q=state_weight(model, 1.0 / model.na, 0.0, 0.3),
        reference="zero",
    )
    return Case(
        name=name,
        title=f"Your model of {model.y_names[0]}",
        section="",
        source="Identified from a record",
        plant=model.plant(),
        designs={
            **predictive(design, *names),
            "integral_of_error": integral,
            **_governed(integral, gains, min(Np, 40)),
        },
        scenario=_trial(model, Np, gains),
        notes=(
            "The plant is the model itself; change its gain or dynamics to see what "
            "an error of the model does.",
            "Signals are deviations from what was taken away before the fit.",
            f"Horizons, weights and scenario are defaults from the slowest pole "
            f"({slowest:.4g}), the delay and the gains.",
        ),
        covariance=covariance,
    )


def design_case(
    design: Design, plant: Any = None, scenario: Scenario | None = None
) -> Case:
    """Case that shows a design of one's own, such as one read from a file.

    Parameters
    ----------
    design : Design
    plant : LinearPlant, ContinuousPlant, StateDependentPlant or a model, optional
        The design's model by default.
    scenario : Scenario, optional
        By default the reference of each output steps from 0 to 1, one after the other.

    Returns
    -------
    Case
        Named "your_design"; its first design is the given one, and a gain comes with a
        governor, a governor with its gain alone.

    Examples
    --------
    >>> model = DifferenceModel([-0.9], [0.1])
    >>> example = design_case(Design("wang_young", model))
    >>> list(example.designs), len(example.scenario)
    (['wang_young'], 65)
    """
    model, assumed = design.model, []
    if plant is None:
        assumed.append("The plant is the model itself.")
    given, continuous = model if plant is None else plant, None
    if isinstance(given, ContinuousPlant):
        continuous, given = given, given.sampled(model.dt)
    if isinstance(given, DifferenceModel | StateDependentModel):
        given = given.plant()
    if scenario is None:
        assumed.append("The reference of each output steps from 0 to 1 in turn.")
        each = max(2 * design.horizon.Np, 40) + 20
        steps = [
            (5 + i * each, np.eye(model.n_y)[: i + 1].sum(axis=0))
            for i in range(model.n_y)
        ]
        scenario = Scenario(piecewise(5 + model.n_y * each, *steps))
    return Case(
        name="your_design",
        title=f"Your design, {design.structure.replace('_', ' ')}",
        section="",
        source="Read from a file",
        plant=given,
        designs={design.structure: design, **_companions(design)},
        scenario=scenario,
        notes=tuple(assumed),
        continuous=continuous,
    )


def _companions(design: Design) -> dict[str, Design]:
    """Designs that belong beside one: what a page shows together."""
    model, K = design.model, design.options.get("K")
    if isinstance(model, StateDependentModel):
        moves = Design("sdp_increments", model, design.horizon, limits=design.limits)
        return _schemes(design if design.structure in SDP_STRUCTURES else moves)
    if design.structure not in ("pip", "governor"):
        return {}
    pair = _pair(model, K, design.limits, design.horizon.Np)
    return {name: other for name, other in pair.items() if name != design.structure}


def _pair(
    model: DifferenceModel, K: Array | None, limits: Limits, Np: int
) -> dict[str, Design]:
    """Gain alone, and with a governor of its reference."""
    pip = Design("pip", model, limits=limits, options={"K": K})
    governor = dataclasses.replace(pip, structure="governor", horizon=Horizon(Np, Np))
    return {"pip": pip, "governor": governor}


def governed(example: Case) -> Case:
    """Case with a gain and with a governor of its reference, where it has none.

    The gain is that of its "pip", or the linear-quadratic one of the weights of its
    first integral-of-error design that has one.

    Parameters
    ----------
    example : Case

    Raises
    ------
    ValueError
        If the case is state-dependent, or no gain was found.

    Examples
    --------
    >>> sorted(governed(wood_berry()).designs.keys() - wood_berry().designs.keys())
    ['governor', 'pip']
    """
    designs = dict(example.designs)
    if {"pip", "governor"} <= set(designs):
        return example
    if example.equation is not None:
        raise ValueError(f"{example.name}: a state-dependent plant has governors else")
    first = next(iter(designs.values()))
    K, source = _gain_of(example)
    pair = _pair(example.model, K, first.limits, min(first.horizon.Np, 40))
    note = f"The governor is over the gain {source}, with the limits of the case."
    return dataclasses.replace(
        example,
        designs={**designs, **pair, "pip": designs.get("pip", pair["pip"])},
        notes=(note, *example.notes),
    )


def _gain_of(example: Case) -> tuple[Array, str]:
    """Find a proportional-integral-plus gain, and say where it is from."""
    pip = example.designs.get("pip")
    if pip is not None:
        return pip.options["K"], "of the case's PIP design"
    for name, design in example.designs.items():
        if design.structure == "integral_of_error":
            try:
                K = lq_gain(example.model, design.Q, design.R)
            except ValueError:
                continue
            return K, f"of the linear-quadratic law with the weights of {name}"
    raise ValueError(
        f"{example.name}: no stabilising gain was found for this model, so there is "
        "nothing to govern"
    )


def _governed(design: Design, gains: Array, Np: int) -> dict[str, Design]:
    """Gain of the design's weights, alone and governed; nothing where there is none."""
    model = design.model
    assert isinstance(model, DifferenceModel)
    try:
        K = lq_gain(model, design.Q, design.R)
    except ValueError:
        return {}
    # a little more than the reference of 1 needs
    most = 1.2 / np.maximum(gains, 1e-3 * gains.max())
    return _pair(model, K, Limits(u=(-most, most)), Np)


def _trial(model: DifferenceModel, Np: int, gains: Array) -> Scenario:
    """Step of the reference, then of what acts at the input, then of what is seen."""
    first, samples = 5, 5 + 4 * Np
    change = np.zeros(model.n_u)
    strongest = gains.argmax()
    # towards the reference, so that inputs which reach it do with less afterwards
    change[strongest] = 0.5 / model.steady_state_gain()[0, strongest]
    at = first + 3 * Np // 2
    seen = piecewise(samples, (first + 3 * Np, np.ones(model.n_v)))
    return Scenario(
        piecewise(samples, (first, 1.0)),
        v=seen if model.n_v else None,
        input_disturbance=piecewise(samples, (at, change)),
    )


# Chapter 8, and plants of its kind


DEADBEAT = {"poles": (0.0, 0.0)}


def bilinear_8_5_1() -> Case:
    """Deadbeat PIP control of a bilinear plant, with and without a governor."""
    model = StateDependentModel([-0.7], ["y[k-2]"])
    limits = Limits(u=(-0.5, 0.5))
    pip = Design("sdp_pip", model, limits=limits, options=DEADBEAT)
    governed = dataclasses.replace(
        pip, structure="sdp_governor", horizon=Horizon(3, 3), reference="preview"
    )
    naive = dataclasses.replace(pip, options={**DEADBEAT, "law": "incremental"})
    mpc = Design("sdp_increments", model, Horizon(10, 4), 1.0, 0.1, limits)
    return Case(
        name="bilinear_8_5_1",
        title="Bilinear plant, deadbeat PIP control and a governor",
        section="8.5.1",
        source="Plant (8.11), poles and limit of section 8.5.1",
        plant=model.plant(),
        designs={
            "sdp_governor": governed,
            "sdp_pip": pip,
            "sdp_pip_naive": naive,
            **_schemes(mpc),
        },
        scenario=Scenario(piecewise(40, (0, 1.0), (3, 2.0)), y0=1.0, u0=0.3),
        notes=(
            "It starts at rest with the sum of the error that holds u = 0.3; the "
            "printed z = 0 is a transient in which y comes to 0 and the gain is "
            "lost.",
            "The governor reads the reference one sample ahead, as printed in (3.12).",
            "sdp_pip_naive sums changes of the input weighed with gains that vary, "
            "(3.13) taken literally: another law, and the one that overshoots.",
            "The predictive designs, not part of this section, are our choice.",
        ),
    )


def product_8_5_2() -> Case:
    """Predictive control of a plant that multiplies its last two inputs."""
    model = StateDependentModel([-0.7], ["u[k-2]"])
    levels = Design(
        "sdp_integral_of_error",
        model,
        Horizon(10, 8),
        (3.0, 0.1),
        1.0,
        Limits(u=(-1.0, 1.0), du=(-0.2, 0.2)),
        options=AS_PRINTED,
    )
    moves = Design(
        "sdp_increments",
        model,
        Horizon(10, 8),
        0.1,
        1.0,
        Limits(u=(-0.82, 0.82), du=(-0.15, 0.15)),
        options={"offset_free": False},
    )
    return Case(
        name="product_8_5_2",
        title="Product of two inputs, predictive control in both forms",
        section="8.5.2",
        source="Plant, weights, horizons and limits of section 8.5.2",
        plant=model.plant(),
        designs={**_schemes(moves), **_schemes(levels, "integral_")},
        scenario=Scenario(
            piecewise(41, (0, 1.0), (5, 2.0)),
            manual=np.where(np.arange(41) < 1, 0.547, np.nan),
            y0=1.0,
            u0=0.547,
            z0=0.0,
        ),
        notes=(
            "u_0 = 0.547 is applied by hand and the controller acts from k = 1; the "
            "exact rest would be u = sqrt(0.3) = 0.54772, and with an integral "
            "z = 2.1556: the printed start is a transient.",
            "The reference is not previewed: the horizon repeats r_k.",
            "Predictions are made as printed, without the last miss of the equation; "
            "the sum of the error is not corrected at limits.",
            "Names say the scheme; those with integral_ weigh the sum of the error "
            "(8.3), the others changes of the input (8.4).",
            "Negative inputs do the same: the plant cannot tell u from -u.",
        ),
    )


def conical_tank() -> Case:
    """Level of a conical tank: fast and sensitive when low, slow when high."""
    model = StateDependentModel(
        a=["dt*out/(area*y[k-1]**2*sqrt(y[k-1])) - 1"],
        b=["dt/(area*y[k-1]**2)"],
        dt=5.0,
        y_names=["level"],
        u_names=["inflow"],
        units={"level": "cm", "inflow": "cm3/s"},
        constants={"dt": 5.0, "area": float(np.pi * 0.25), "out": 60.0},
    )
    limits = Limits(u=(0.0, 800.0), du=(-60.0, 60.0), y=(12.0, 75.0), outputs="soft")
    design = Design("sdp_increments", model, Horizon(20, 5), 1.0, 1e-3, limits)
    start = 20.0
    steps = (0, start), (5, 40.0), (40, 60.0), (75, 18.0)
    return Case(
        name="conical_tank",
        title="Conical tank",
        section="",
        source="Synthetic: cone of half the radius per height, outflow 60 sqrt(level)",
        plant=model.plant(),
        designs=_schemes(design),
        scenario=Scenario(
            piecewise(120, *steps), y0=start, u0=60.0 * float(np.sqrt(start))
        ),
        notes=(
            "Balance of volume, stepped explicitly every 5 s: area * level^2 times "
            "the change of the level is inflow minus 60 sqrt(level).",
            "The area of the surface grows with the square of the level, so at 20 cm "
            "the tank is nine times as fast as at 60 cm.",
            "Below 12 cm the steps are too long for the outflow; a soft limit keeps "
            "the level above.",
        ),
    )


def stirred_reactor() -> Case:
    """Exothermic reactor held at a temperature at which it would run away."""
    rate = "rate*exp(-E/T[k-1])"
    burnt = f"(1 + h*feed/c[k-1])/(1 + h*(1 + {rate}))"
    model = StateDependentModel(
        a=[
            [
                [f"-{burnt}", 0.0],
                [f"-h*heat*{rate}*{burnt}/w", "-(1 + h*warm/T[k-1])/w"],
            ]
        ],
        b=[[[0.0], ["h*jacket/w"]]],
        dt=3.0,
        y_names=["c", "T"],
        u_names=["coolant"],
        units={"c": "mol/L", "T": "K", "coolant": "K"},
        constants={
            "h": 0.05,
            "rate": 7.2e10,
            "E": 8750.0,
            "feed": 1.0,
            "warm": 350.0,
            "heat": 5e4 / 239.0,
            "jacket": 5e4 / (100.0 * 239.0),
            "w": 1.0 + 0.05 * (1.0 + 5e4 / (100.0 * 239.0)),
        },
    )
    limits = Limits(u=(280.0, 320.0), du=(-2.0, 2.0))
    design = Design("sdp_increments", model, Horizon(16, 6), (0.0, 1.0), 0.2, limits)

    def rest(temperature: float) -> tuple[float, float]:
        rate = 7.2e10 * np.exp(-8750.0 / temperature)
        return float(1.0 / (1.0 + rate)), temperature

    steps = (0, rest(350.0)), (5, rest(360.0)), (45, rest(340.0))
    c, T = rest(350.0)
    made = 5e4 / 239.0 * (1.0 - c)
    cool = T - (350.0 - T + made) / (5e4 / (100.0 * 239.0))
    return Case(
        name="stirred_reactor",
        title="Stirred tank reactor at an unstable temperature",
        section="",
        source="The exothermic A to B reactor of textbooks: q/V = 1/min, k0 = 7.2e10/"
        "min, E/R = 8750 K, -dH = 5e4 J/mol, rho cp = 239 J/(L K), UA = 5e4 J/(min K)",
        plant=model.plant(),
        designs=_schemes(design),
        scenario=Scenario(piecewise(90, *steps), y0=np.array([c, T]), u0=cool),
        notes=(
            "Balances of mass and heat, stepped every 0.05 min, implicitly where they "
            "are linear; constant terms are carried by 1/c and 1/T.",
            "Only the temperature is weighed; the reference of the concentration is "
            "where it comes to rest.",
            "At 350 K the reactor is unstable: without control it cools down or runs "
            "away.",
        ),
    )


def equation_case(
    model: StateDependentModel, target: float = 1.0, samples: int = 60
) -> Case:
    """Case of any state-dependent equation with one input and one output.

    Parameters
    ----------
    model : StateDependentModel
    target : float
        Reference from sample 5 on.
    samples : int

    Raises
    ------
    ValueError
        If the model has several inputs or outputs, or is not finite at its start.
    """
    if (model.n_y, model.n_u) != (1, 1):
        raise ValueError(
            f"the model has {model.n_y} outputs and {model.n_u} inputs, expected one "
            "of each"
        )
    u0 = 0.1
    try:
        y0 = float(model.rest(u0, 0.5)[0])
    except ValueError:
        y0 = 0.5
    model.frozen(np.full((model.y_lags, 1), y0), np.full((model.u_lags, 1), u0))
    moves = Design("sdp_increments", model, Horizon(10, 4), 1.0, 0.1)
    levels = dataclasses.replace(moves, structure="sdp_integral_of_error")
    size = (model.na + 1) + (model.nb - 1)
    levels = dataclasses.replace(levels, Q=(1.0,) + (0.0,) * (size - 2) + (0.1,))
    return Case(
        name="own",
        title="Your own equation",
        section="",
        source="Typed",
        plant=model.plant(),
        designs={**_schemes(moves), **_schemes(levels, "integral_")},
        scenario=Scenario(piecewise(samples, (0, y0), (5, target)), y0=y0, u0=u0),
        notes=(
            "It starts with u = 0.1, at the rest nearest to y = 0.5 if there is one.",
            "Weights are 1 on the output and 0.1 on moves; with an integral 1 on the "
            "present output, 0.1 on the sum of the error and 0.1 on the input.",
            "The plant obeys the equation exactly.",
        ),
    )


def _schemes(design: Design, prefix: str = "") -> dict[str, Design]:
    """Design with each way to settle plan and predictions."""
    settlings = {
        "frozen": Settling("frozen"),
        "iterated": Settling("iterated"),
        "gauss_newton": Settling("gauss-newton"),
        "newton": Settling("newton"),
    }
    return {
        prefix + name: dataclasses.replace(
            design, options={**design.options, "settling": settling}
        )
        for name, settling in settlings.items()
    }


LINEAR_CASES: dict[str, Callable[[], Case]] = {
    "governor_3_4": governor_3_4,
    "double_integrator_4_4_1": double_integrator_4_4_1,
    "ifac93_4_4_2": ifac93_4_4_2,
    "shell_5_3_2": shell_5_3_2,
    "marginally_stable_6_3_2": marginally_stable_6_3_2,
    "ifac93_6_3_3": ifac93_6_3_3,
    "gasifier_6_3_4": gasifier_6_3_4,
    "measured_disturbance_7_4_1": measured_disturbance_7_4_1,
    "temperature_7_4_2": temperature_7_4_2,
    "quadruple_tank_minus": quadruple_tank_minus,
    "quadruple_tank_plus": quadruple_tank_plus,
    "wood_berry": wood_berry,
}
"""Cases of difference equations with constant coefficients."""

VARYING_CASES: dict[str, Callable[[], Case]] = {
    "bilinear_8_5_1": bilinear_8_5_1,
    "product_8_5_2": product_8_5_2,
    "conical_tank": conical_tank,
    "stirred_reactor": stirred_reactor,
}
"""Cases of state-dependent plants."""

CASES = {**LINEAR_CASES, **VARYING_CASES}
"""Functions that build the cases, by name."""
