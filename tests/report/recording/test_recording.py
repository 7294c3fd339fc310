"""The rerun recording, read back as the viewer would read it, and how the viewer is opened."""

from __future__ import annotations

import dataclasses
import itertools
import math
import subprocess
import sys
import time as clock
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest
from rerun.chunk import RrdReader
from support import recording

import quadsim.report.recording as recording_module
from quadsim.controller import SOLVED, UNCONSTRAINED
from quadsim.flight.audit import SIGNALS, audit, margins_sampled
from quadsim.report.recording import open_viewer, world, write_recording
from quadsim.report.recording.world import PANELS, TIMELINE
from quadsim.rollout.flown import Flight
from quadsim.rotation import body_to_world
from quadsim.state import EULER, POSITION


class Content:
    """What stands in a recording's file."""

    def __init__(self, path: Path) -> None:
        self.reader = RrdReader(path)
        self.chunks = self.reader.stream().to_chunks()

    @property
    def entities(self) -> set[str]:
        return {chunk.entity_path for chunk in self.chunks}

    def times(self, entity: str) -> np.ndarray:
        """Times of an entity's rows [s]."""
        return self._column(entity, TIMELINE).to_numpy().astype("timedelta64[ns]").astype(float) * 1e-9

    def rows(self, entity: str, component: str) -> list:
        """The values of one component, one list per row."""
        return self._column(entity, component).to_pylist()

    def _column(self, entity: str, name: str):
        (column,) = (
            batch.column(field)
            for chunk in self.chunks
            if chunk.entity_path == entity
            for batch in [chunk.to_record_batch()]
            for field in batch.schema.names
            if field == name or field.endswith(f":{name}")
        )
        return column


@pytest.fixture(scope="module")
def path(short_run: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "flight.rrd"
    write_recording(short_run, path)
    return path


@pytest.fixture(scope="module")
def content(path: Path) -> Content:
    return Content(path)


@pytest.fixture
def record(tmp_path: Path) -> Callable[[Flight], Content]:
    def write_and_read(run: Flight) -> Content:
        write_recording(run, tmp_path / "flight.rrd")
        return Content(tmp_path / "flight.rrd")

    return write_and_read


def test_the_vehicle_is_where_the_plant_was(content: Content, short_run: Flight) -> None:
    plant = short_run.log.plant
    np.testing.assert_allclose(content.times("/world/vehicle"), plant.t, atol=1e-9)
    moved = np.array(content.rows("/world/vehicle", "translation"))[:, 0]
    np.testing.assert_allclose(moved, plant.state[:, POSITION], atol=1e-5)
    x, y, z, w = np.array(content.rows("/world/vehicle/body", "quaternion"))[:, 0].T
    forward = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1)
    np.testing.assert_allclose(forward, body_to_world(plant.state[:, EULER])[:, :, 0], atol=1e-5)


def test_thrusts_stand_on_the_rotors_and_grow_with_squared_speeds(content: Content, short_run: Flight) -> None:
    vehicle = short_run.vehicle
    origins = np.array(content.rows("/world/vehicle/body/thrust", "origins")[0])
    np.testing.assert_allclose(origins[:, :2], vehicle.hubs[:, :2], atol=1e-6)
    arrows = np.array(content.rows("/world/vehicle/body/thrust", "vectors"))
    expected = vehicle.arm_length * (short_run.log.plant.speeds / vehicle.hover_speed) ** 2
    np.testing.assert_allclose(arrows[..., 2], expected, rtol=1e-5)
    np.testing.assert_array_equal(arrows[..., :2], 0.0)


def test_every_period_has_its_predicted_horizon(content: Content, short_run: Flight) -> None:
    control = short_run.log.control
    predicted = short_run.log.predicted
    assert predicted is not None
    np.testing.assert_allclose(content.times("/world/horizon"), control.t, atol=1e-9)
    strips = np.array(content.rows("/world/horizon", "strips"))[:, 0]
    np.testing.assert_allclose(strips[:, 0], control.state[:, POSITION], atol=1e-5)
    np.testing.assert_allclose(strips[:, 1:], predicted, atol=1e-5)


def test_the_flown_path_grows_piece_by_piece_without_gaps(content: Content, short_run: Flight) -> None:
    pieces = [np.array(row[0]) for row in content.rows("/world/flown", "strips")]
    position = short_run.log.plant.state[:, POSITION]
    ends = [*short_run.log.control.t[1:], short_run.log.plant.t[-1]]
    np.testing.assert_allclose(content.times("/world/flown"), ends, atol=1e-9)
    assert len(pieces) == len(ends)
    np.testing.assert_allclose(pieces[0][0], position[0], atol=1e-5)
    for piece, following in itertools.pairwise(pieces):
        np.testing.assert_array_equal(piece[-1], following[0])
    np.testing.assert_allclose(pieces[-1][-1], position[-1], atol=1e-5)
    (whole,) = content.rows("/world/path", "strips")[0]
    np.testing.assert_allclose(whole, position, atol=1e-5)


def test_signals_are_the_audited_ones(content: Content, short_run: Flight) -> None:
    log = short_run.log
    for name, signal in SIGNALS.items():
        if name == "thrust":  # this flight has no target for it
            continue
        of_plant = signal.plant is not None
        t = log.plant.t if of_plant else log.control.t
        expected = signal.plant(log.plant) if signal.plant is not None else signal.sampled(log.control)
        np.testing.assert_allclose(content.times(f"/signals/{name}"), t, atol=1e-9)
        np.testing.assert_array_equal(content.rows(f"/signals/{name}", "scalars"), expected.reshape(len(t), -1))
        assert all(signal.unit in label for label in content.rows(f"/signals/{name}", "names")[0])
        assert sum(name in names for names in PANELS.values()) == 1


def test_references_are_in_the_units_of_their_signals(record: Callable[[Flight], Content], short_run: Flight) -> None:
    reference = short_run.log.control.reference + np.eye(4)[3]  # the paper's yaw reference is zero
    control = dataclasses.replace(short_run.log.control, reference=reference)
    content = record(dataclasses.replace(short_run, log=dataclasses.replace(short_run.log, control=control)))
    np.testing.assert_array_equal(np.ravel(content.rows("/reference/z", "scalars")), reference[:, 2])
    np.testing.assert_array_equal(np.ravel(content.rows("/reference/yaw", "scalars")), np.degrees(reference[:, 3]))


def test_bounds_margins_and_verdicts_of_the_scenario(content: Content, short_run: Flight) -> None:
    reached = [limit for limit in short_run.limits if limit.start <= short_run.log.control.t[-1]]
    assert {limit.name for limit in reached} >= {"roll", "pitch", "speed", "slew"}
    assert {e.split("/")[2] for e in content.entities if e.startswith("/limits/")} == {limit.name for limit in reached}
    for limit in reached:
        assert content.rows(f"/limits/{limit.name}", "scalars") == [[limit.lower, limit.upper]] * 2
        np.testing.assert_allclose(content.times(f"/limits/{limit.name}"), [0.0, short_run.log.plant.t[-1]])
        margins = np.ravel(content.rows(f"/margins/{limit.name}", "scalars"))
        np.testing.assert_array_equal(margins, margins_sampled(limit, short_run.log))
    states = [state for row in content.rows("/verdicts/speed", "state") for state in row]
    assert set(states) == {"holds", "active"}  # the paper's take-off is at full speed
    assert all(before != after for before, after in itertools.pairwise(states))


def test_forces_torques_wind_battery_and_lagging_rotors_have_their_curves(
    record: Callable[[Flight], Content], short_run: Flight
) -> None:
    plant = short_run.log.plant
    rng = np.random.default_rng(0)
    wrench = rng.normal(size=(plant.t.size, 6))
    wind = rng.normal(size=(plant.t.size, 3))
    battery = rng.uniform(size=(plant.t.size, 2))
    plant = dataclasses.replace(plant, speeds=plant.speeds - 1.0, wrench=wrench, wind=wind, battery=battery)
    run = dataclasses.replace(short_run, log=dataclasses.replace(short_run.log, plant=plant))
    content = record(run)
    curves = {"force": wrench[:, :3], "torque": wrench[:, 3:], "wind": wind}
    for name, expected in (curves | {"voltage": battery[:, :1], "charge": battery[:, 1:]}).items():
        np.testing.assert_array_equal(content.rows(f"/effects/{name}", "scalars"), expected)
        np.testing.assert_allclose(content.times(f"/effects/{name}"), plant.t, atol=1e-9)
    np.testing.assert_allclose(content.rows("/effects/commanded", "scalars"), plant.speeds + 1.0, atol=1e-9)
    arrows = np.array(content.rows("/world/vehicle/external_force", "vectors"))[:, 0]
    vehicle = run.vehicle
    as_thrusts = vehicle.arm_length * 4.0 * wrench[:, :3] / (vehicle.mass * vehicle.gravity)
    np.testing.assert_allclose(arrows, world._FORCE_SCALE * as_thrusts, rtol=1e-5, atol=1e-9)
    gusts = np.array(content.rows("/world/vehicle/wind", "vectors"))[:, 0]
    longest = 1.5 * vehicle.arm_length / np.linalg.norm(wind, axis=1).max()
    np.testing.assert_allclose(gusts, longest * wind, atol=1e-6)
    blueprint = content.reader.stream(store=content.reader.blueprints()[0]).to_chunks()
    assert "Effects" in "".join(str(column) for chunk in blueprint for column in chunk.to_record_batch().columns)


def named_by_the_layout(content: Content) -> list[list[str]]:
    """The entities that each plot of the layout names."""
    blueprint = content.reader.stream(store=content.reader.blueprints()[0]).to_chunks()
    batches = [chunk.to_record_batch() for chunk in blueprint if chunk.entity_path.endswith("/ViewContents")]
    queries = [row for batch in batches for row in batch.column("ViewContents:query").to_pylist()]
    return [names for names in queries if not any("*" in name for name in names)]


def has_values(content: Content, entity: str) -> bool:
    """Whether an entity has a finite number, or a state."""
    if entity not in content.entities:
        return False
    kind = "state" if entity.startswith("/verdicts") else "scalars"
    values = [value for row in content.rows(entity, kind) for value in row]
    return bool(values) and (kind == "state" or bool(np.isfinite(np.array(values, float)).any()))


@pytest.mark.parametrize("case", ["as flown", "with a target", "by a law without limits", "of one period"])
def test_a_plot_names_only_what_was_recorded_and_none_is_blank(
    record: Callable[[Flight], Content], short_run: Flight, case: str
) -> None:
    log = short_run.log
    limits = short_run.limits
    assert any(limit.start > 6.0 for limit in limits), "one that this flight does not reach"
    if case == "with a target":
        target = np.full((log.control.t.size, 4), 39.0)
        thrust = np.full(log.plant.t.size, 40.0)
        log = dataclasses.replace(
            log,
            control=dataclasses.replace(log.control, target=target),
            plant=dataclasses.replace(log.plant, thrust=thrust),
        )
    if case == "by a law without limits":
        nothing = np.full(log.control.t.size, math.nan)
        log = dataclasses.replace(log, timing=dataclasses.replace(log.timing, solve_ms=nothing))
        limits = ()
    if case == "of one period":
        limits = tuple(limit for limit in limits if limit.start > 0.0)
    content = record(dataclasses.replace(short_run, log=log, findings=audit(log, limits)))
    plots = named_by_the_layout(content)
    assert len(plots) > 10
    for names in plots:
        assert names
        assert [name for name in names if not has_values(content, f"/{name}")] == []
    assert (["signals/thrust"] in plots) == (case == "with a target")


def test_dashes_of_the_reference_lie_on_a_small_course(record: Callable[[Flight], Content], short_run: Flight) -> None:
    angle = np.linspace(0.0, 4.0 * math.pi, short_run.log.control.t.size)
    radius = 0.2
    reference = short_run.log.control.reference.copy()
    reference[:, :3] = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    control = dataclasses.replace(short_run.log.control, reference=reference)
    content = record(dataclasses.replace(short_run, log=dataclasses.replace(short_run.log, control=control)))
    dashes = [np.array(dash) for dash in content.rows("/world/reference", "strips")[0]]
    assert len(dashes) > 3
    for dash in dashes:
        between = np.concatenate([dash, 0.5 * (dash[1:] + dash[:-1])])
        sagitta = radius * (1.0 - math.cos(0.5 * (angle[1] - angle[0])))  # of the samples' own polygon
        assert np.abs(np.hypot(*between.T[:2]) - radius).max() < 2.0 * sagitta
    lengths = [np.linalg.norm(np.diff(dash, axis=0), axis=1).sum() for dash in dashes]
    assert np.ptp(lengths) < 1e-3
    assert sum(lengths) == pytest.approx(2.0 * math.pi * radius, rel=0.15), "half of the course is gaps"


def rerun(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs rerun's command line."""
    return subprocess.run([*recording_module._VIEWER[:4], *arguments], capture_output=True, text=True, timeout=60)


def test_rerun_finds_nothing_wrong_with_the_file_and_the_layout_is_in_force(path: Path) -> None:
    verified = rerun("rrd", "verify", str(path))
    assert verified.returncode == 0, verified.stderr
    assert "make_active: true, make_default: true" in rerun("rrd", "print", str(path)).stdout
    assert path.stat().st_size < 2_000_000


def test_events_report_each_change_of_the_solver_why_it_failed_and_the_end(
    record: Callable[[Flight], Content], short_run: Flight
) -> None:
    control = short_run.log.control
    K = control.t.size
    status = [SOLVED] * K
    fallback = control.fallback.copy()
    status[20:30] = [UNCONSTRAINED] * 10
    status[40:43] = ["infeasible"] * 3
    fallback[40:43] = [1, 1, 2]
    fallback[-40:] = 2
    by = ["piqp-dense"] * 20 + ["gain"] * 10 + ["core"] * 10 + ["fallback"] * 3 + ["piqp-dense"] * (K - 43)
    changed = dataclasses.replace(control, status=tuple(status), answered_by=tuple(by), fallback=fallback)
    log = dataclasses.replace(short_run.log, control=changed, reason="the battery fell off")
    result = {"time": 2.0, "sentence": "cannot hold together: roll upper by 1 deg", "advice": "to try: more"}
    controller = {**short_run.summary["controller"], "unrecovered": 40}
    content = record(recording(dataclasses.replace(short_run, log=log), diagnosis=result, controller=controller))
    expected = [
        (0.0, "INFO", "solved by piqp-dense, fallback 0"),
        (1.0, "INFO", "unconstrained by gain, fallback 0"),
        (1.5, "INFO", "solved by core, fallback 0"),
        (2.0, "ERROR", "cannot hold together: roll upper by 1 deg"),
        (2.0, "ERROR", "to try: more"),
        (2.0, "WARN", "infeasible, fallback 1"),
        (2.1, "WARN", "infeasible, fallback 2"),
        (2.15, "INFO", "solved by piqp-dense, fallback 0"),
        (4.0, "ERROR", "40 periods in fallback, never recovered"),
        (4.0, "WARN", "solved, fallback 2"),
        (6.0, "ERROR", "aborted: the battery fell off"),
    ]
    times = content.times("/events").round(9).tolist()
    levels, texts = ([row[0] for row in content.rows("/events", name)] for name in ("level", "text"))
    assert sorted(zip(times, levels, texts, strict=True)) == expected
    summary = content.rows("/summary", "text")[0][0]
    assert "cannot hold together: roll upper" in summary


def test_the_summary_has_no_key_without_a_value_and_plots_end_with_the_flight(
    content: Content, short_run: Flight
) -> None:
    summary = content.rows("/summary", "text")[0][0]
    lines = [line.removeprefix("- ").partition(": ") for line in summary.splitlines() if line.startswith("- ")]
    assert len(lines) > 10
    assert [value for _, _, value in lines if value.strip("* ") in ("", "-")] == []
    assert "events" not in summary, "it has none"
    blueprint = content.reader.stream(store=content.reader.blueprints()[0]).to_chunks()
    batches = [chunk.to_record_batch() for chunk in blueprint if chunk.entity_path.endswith("/TimeAxis")]
    ranges = [str(batch.to_pydict()) for batch in batches]
    end = round(1e9 * short_run.end)
    assert ranges
    assert all(str(end) in text for text in ranges)


def test_a_flight_without_predictions_or_finite_end_is_recorded(
    record: Callable[[Flight], Content], short_run: Flight
) -> None:
    state = short_run.log.plant.state.copy()
    state[-1] = math.nan
    log = dataclasses.replace(
        short_run.log, predicted=None, plant=dataclasses.replace(short_run.log.plant, state=state)
    )
    run = dataclasses.replace(short_run, log=log)
    entities = record(run).entities
    assert not [entity for entity in entities if any(word in entity for word in ("horizon", "effects", "force"))]
    assert np.isfinite(world._overview(run)).all()


def test_the_viewer_is_given_the_file_and_listens_to_this_machine_alone(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    notes = tmp_path / "arguments"
    program = f"import sys, pathlib; pathlib.Path({str(notes)!r}).write_text(' '.join(sys.argv[1:])); sys.exit(130)"
    monkeypatch.setattr(recording_module, "_VIEWER", (sys.executable, "-c", program, *recording_module._VIEWER[4:]))
    open_viewer(path)  # closed by Ctrl-C
    assert notes.read_text() == f"--bind=127.0.0.1 --port=auto {path}"
    open_viewer(path, web=True)
    assert "--web-viewer" in notes.read_text().split()


def test_a_signal_ends_the_viewer_and_the_processes_that_it_started(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    note = tmp_path / "started"
    program = f"""
import os, pathlib, signal, subprocess, sys, time
started = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
pathlib.Path({str(note)!r}).write_text(str(started.pid))
os.kill(os.getppid(), signal.SIGINT)
time.sleep(60)
"""
    monkeypatch.setattr(recording_module, "_VIEWER", (sys.executable, "-c", program))
    open_viewer(path, web=True)
    started = int(note.read_text())
    deadline = clock.monotonic() + 10.0
    while is_running(started) and clock.monotonic() < deadline:
        clock.sleep(0.02)
    assert not is_running(started)


def is_running(process: int) -> bool:
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
