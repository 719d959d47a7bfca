"""The benchmarks run, quickly, and give numbers; how large these are is not tested."""

import importlib
import math
import sys

import pytest
from conftest import ROOT

MODULES = [
    "steps",
    "designs",
    "imports",
    "ensembles",
    "identification",
    "state_dependent",
    "peers",
]
BESIDE_PEERS = {"state_dependent", "peers"}
"""Those that measure nothing where no peer is installed."""


@pytest.fixture
def benchmark(request, monkeypatch):
    """Import a benchmark as the command does, from its folder."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "benchmarks"), *sys.path])
    return importlib.import_module(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("benchmark", MODULES, indirect=True)
def test_a_quick_run_gives_finite_figures_or_says_what_it_skips(benchmark):
    """Finite, positive numbers, or a word why there are none."""
    said = []
    figures = list(benchmark.measure(quick=True, say=said.append))
    for figure in figures:
        numbers = figure.value, figure.p99, figure.against, figure.against_p99
        for number in (*numbers, figure.ratio):
            assert math.isfinite(number), figure
            assert number > 0.0, figure
        assert figure.part
        assert figure.size
        assert figure.met is None or figure.target, figure
    assert said
    if not figures:
        assert benchmark.__name__ in BESIDE_PEERS
        assert any("skipped" in words and "nmss-lab[bench]" in words for words in said)


@pytest.mark.parametrize("benchmark", ["peers"], indirect=True)
def test_an_absent_peer_is_skipped_with_a_word(benchmark, monkeypatch):
    """Nothing is measured, and everyone that is missing is named."""
    absent = [peer._replace(module=None) for peer in benchmark.PEERS]
    monkeypatch.setattr(benchmark, "PEERS", absent)
    said = []
    assert list(benchmark.measure(say=said.append)) == []
    assert len(said) == len(absent)
    for words, peer in zip(said, absent, strict=True):
        assert peer.name in words
        assert "skipped" in words


@pytest.mark.parametrize("benchmark", ["frame"], indirect=True)
def test_tables_say_whether_a_target_is_met(benchmark):
    """Met, missed or none; and a bar within a cell does not break the table."""
    parts = "Part", "name", "size", [1.0, 2.0, 3.0], "a | baseline", [4.0, 8.0, 12.0]
    plain = benchmark.compared(*parts)
    met, missed = (
        benchmark.compared(*parts, target="small", bound=bound) for bound in (0.3, 0.2)
    )
    assert plain.ratio == 0.25
    assert (plain.met, met.met, missed.met) == (None, True, False)
    table = benchmark.markdown([plain, met, missed])
    rows = [row for row in table.splitlines() if row.startswith("|")]
    assert {row.count("|") - row.count("\\|") for row in rows} == {8}
    assert "small: met" in table
    assert "small: **missed**" in table
