"""Results as DataFrames: every result with numbers has one, and its numbers are numbers."""

from __future__ import annotations

import importlib
from collections.abc import Iterator

import quadsim
from quadsim.console.results import Document, Result, Tabular
from quadsim.features.entries import FEATURES
from quadsim.rollout.flight_plot import Overlay

MODULES = (
    *("quadsim.rollout.flown", "quadsim.rollout.flight_comparison", "quadsim.scenarios.catalogue"),
    *("quadsim.features.campaign.campaign", "quadsim.features.campaign.paired", "quadsim.features.campaign.sweep"),
    *("quadsim.features.papers.reproduction", "quadsim.features.stability.report"),
    *("quadsim.features.identify.report", "quadsim.features.design.vehicle_report"),
)


def every_kind(kind: type[Result]) -> Iterator[type[Result]]:
    for child in kind.__subclasses__():
        yield child
        yield from every_kind(child)


def test_every_result_but_texts_and_plots_has_a_data_frame() -> None:
    for module in MODULES:
        parts = module.split(".")
        if parts[1] != "features" or parts[2] in FEATURES:
            importlib.import_module(module)
    kinds = [kind for kind in every_kind(Result) if kind is not Tabular and not issubclass(kind, Document | Overlay)]
    ours = [kind for kind in kinds if kind.__module__.startswith("quadsim.")]
    assert len(ours) >= 4
    assert [kind.__name__ for kind in ours if not hasattr(kind, "to_pandas")] == []


def test_a_comparison_has_numbers_of_each_flight() -> None:
    hover = quadsim.load("hover").replace({"duration": 0.5})
    flights = [quadsim.fly(hover, progress=False) for _ in range(2)]
    frame = quadsim.compare(*flights, names=["a", "b"], progress=False).to_pandas()  # type: ignore[attr-defined]
    assert frame["flight"].tolist() == ["a", "b"]
    assert frame["margin.roll"].tolist() == [finding.margin for finding in (flights[0].audit[0], flights[1].audit[0])]
    for column in ("duration", "rmse.x", "margin.roll", "time_violated.roll", "step_ms.p50"):
        assert frame[column].dtype.kind == "f"
    assert frame["satisfied.roll"].dtype.kind == "b"


def test_the_catalogue_has_a_row_for_each_name() -> None:
    catalogue = quadsim.catalogue()
    frame = catalogue.to_pandas()
    assert (frame["kind"] == "scenario").sum() == len(catalogue.scenarios)
    assert set(frame["kind"]) == {"scenario", "campaign", "vehicle", "controller", "paper", "solver"}
