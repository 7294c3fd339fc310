"""Films: the numbers behind the frames, the captions, and the MP4 and GIF that come out of the child processes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from support import decode, judged_by, recording

from quadsim.errors import FileError, OutputError, ParameterError, RenderingUnavailableError
from quadsim.flight.audit import Limit, audit
from quadsim.palette import ON_DARK, rgb
from quadsim.report.film import video
from quadsim.report.film.captions import CaptionPainter, margin_rows
from quadsim.report.film.frames import filmed, make_footage, ranked_tracks
from quadsim.report.film.video import (
    Estimate,
    film_speed,
    frame_count,
    frame_rate,
    render_gif,
    render_video,
    rendering_backend,
    write_poster,
)
from quadsim.rollout.flown import Flight
from quadsim.rollout.rollout import Rollout
from quadsim.rotation import body_to_world
from quadsim.scenarios.loading import load_scenario
from quadsim.state import EULER, INDEX, POSITION

pytestmark = pytest.mark.slow("films")


@pytest.fixture(scope="module")
def backend() -> str:
    try:
        return rendering_backend()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))


@pytest.mark.representative("films")
def test_the_film_has_the_frames_requested(
    backend: str, short_run: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of each second, in two pieces."""
    path = tmp_path / "film" / "flight.mp4"
    reports = list[tuple[int, int]]()
    before = dict(os.environ)
    path.parent.mkdir()
    monkeypatch.setattr(video, "_FEWEST_FRAMES", 3)
    render_video(short_run, path, workers=2, fps=1, progress=lambda *report: reports.append(report))
    assert dict(os.environ) == before, "the caller's environment is left as it is"
    assert reports == sorted(reports)
    assert reports[-1] == (6, 6)
    assert [entry.name for entry in path.parent.iterdir()] == ["flight.mp4"]
    frames, meta = decode(path)
    assert frames.shape == (6, 720, 1280, 3)
    assert (meta["fps"], meta["codec"], meta["pix_fmt"][:7]) == (1.0, "h264", "yuv420p")
    sky = frames[:, 60:100, 500:780].mean(axis=(1, 2))
    ground = frames[:, 500:540, 500:780].mean(axis=(1, 2))
    assert (sky[:, 2] > sky[:, 0] + 15.0).all()  # a blue sky above a grey floor, in every frame of both pieces
    assert (np.ptp(ground, axis=1) < 40.0).all()
    assert ground.min() > 60.0
    assert np.abs(frames[5].astype(int) - frames[0]).mean() > 2.0
    assert path.stat().st_size < 2_000_000


def test_a_long_film_has_fewer_frames_per_second_unless_told() -> None:
    assert [frame_rate(length) for length in (6.0, 29.9, 30.0, 60.0)] == [30, 30, 20, 20]
    assert frame_rate(60.0, 50) == 50
    assert (frame_count(60.0, 20), frame_count(30.0, 20), frame_count(0.01, 30)) == (400, 600, 1)
    assert [film_speed(length) for length in (6.0, 30.0, 30.1, 60.0)] == [1.0, 1.0, 3.0, 3.0]
    for wrong in (0, 121, 24.0, True):
        with pytest.raises(ParameterError, match="--fps"):
            frame_rate(6.0, wrong)  # type: ignore[arg-type]


def told(frames: tuple[int, ...], reports: list[tuple[float, int, int]], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What an estimate of films of so many frames says, of which (time, done, total) are reported."""
    times = iter([0.0, *(time for time, _, _ in reports)])
    said = list[str]()
    monkeypatch.setattr(video.clock, "monotonic", lambda: next(times))
    monkeypatch.setattr(video._log, "info", lambda text, *values: said.append(text % values))
    estimate = Estimate(frames, "the page is there")
    for _, *report in reports:
        estimate(*report)
    monkeypatch.undo()
    return said


def test_the_estimate_is_what_the_first_frames_take(monkeypatch: pytest.MonkeyPatch) -> None:
    """The renderer starts in 2 s; 10 frames/s: 880 are left, and as many as of the other film, which starts too."""
    reports = [(2.0, 1, 900), (3.0, 11, 900), (4.0, 21, 900), (90.0, 899, 900)]
    assert told((900,), reports, monkeypatch) == ["film: about 90 s; the page is there"]
    assert told((900, 600), reports, monkeypatch) == ["films: about 2 min; the page is there"]
    slow = [(time if time < 3.0 else 2.0 + 10.0 * (time - 2.0), *rest) for time, *rest in reports]
    assert told((900,), slow, monkeypatch) == ["film: about 15 min; the page is there"]


def test_an_estimate_waits_for_a_film_that_is_long_enough_to_be_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told((5,), [(0.0, 0, 5), (1.0, 1, 5), (1.5, 5, 5)], monkeypatch) == []
    two = [(1.0, 1, 5), (1.5, 5, 5), (2.0, 1, 500), (4.0, 21, 500)]
    assert told((5, 500), two, monkeypatch) == ["films: about 50 s; the page is there"]


def test_a_gif_is_small_and_moves(backend: str, short_run: Flight, tmp_path: Path) -> None:
    render_gif(short_run, tmp_path / "film.gif")
    frames = iio.imread(tmp_path / "film.gif")
    assert frames.shape[:3] == (8, 270, 480)
    assert np.abs(frames[3].astype(int) - frames[0]).mean() > 2.0
    assert (tmp_path / "film.gif").stat().st_size < 600_000


@pytest.mark.parametrize("name", ["drone #2", "what?", "100 %d", "it's", "a:b"])
def test_a_folder_of_any_name_has_its_film_its_gif_and_its_poster(backend: str, tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    folder.mkdir()
    flight = Rollout(load_scenario("hover", ["duration=0.2"])).fly()
    render_video(flight, folder / "film.mp4", fps=10)
    render_gif(flight, folder / "film.gif")
    assert write_poster(folder / "film.mp4", folder / "film.jpg")
    assert {path.name for path in folder.iterdir()} == {"film.mp4", "film.gif", "film.jpg"}


def test_a_flight_of_one_period_far_away_can_be_filmed_and_of_none_cannot(
    backend: str, empty_run: Flight, tmp_path: Path
) -> None:
    far = load_scenario("paper-constrained", ["duration=0.05", "initial.position=[9e3, -9e3, 9e3]", "constraints=[]"])
    render_video(Rollout(far).fly(), tmp_path / "film.mp4", width=320, height=180, fps=10, workers=1)
    frames, _ = decode(tmp_path / "film.mp4")
    assert frames.shape == (1, 180, 320, 3)
    assert frames.mean() > 30.0
    with pytest.raises(FileError, match="film"):
        render_video(empty_run, tmp_path / "none.mp4")
    assert not (tmp_path / "none.mp4").exists()


@pytest.fixture
def fake_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that report one frame; the one that renders the first frames then waits, another fails."""
    script = (
        "import json, sys, time\n"
        "print(1, flush=True)\n"
        "open(sys.argv[4], 'w').write('half a film')\n"
        "if json.loads(sys.argv[3])['first'] == 0: time.sleep(600)\n"
        "sys.exit('Traceback ...\\nGLError: the picture is lost')\n"
    )
    monkeypatch.setattr(video, "_WORKER", (sys.executable, "-c", script))
    monkeypatch.setattr(video, "rendering_backend", lambda: "egl")


@pytest.mark.usefixtures("fake_worker")
def test_a_failing_worker_stops_the_others_and_leaves_nothing(short_run: Flight, tmp_path: Path):
    target = tmp_path / "film.mp4"
    target.write_bytes(b"an older film")
    with pytest.raises(OutputError, match="exists"):
        render_video(short_run, target, workers=2)
    with pytest.raises(OutputError, match="GLError") as caught:
        render_video(short_run, target, workers=2, overwrite=True)
    assert caught.value.path == target
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.mp4"]
    assert target.read_bytes() == b"an older film"


@pytest.mark.usefixtures("fake_worker")
def test_ctrl_c_kills_the_workers(short_run: Flight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    started: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def spy(*arguments: object, **options: object) -> subprocess.Popen[bytes]:
        started.append(popen(*arguments, **options))
        return started[-1]

    def interrupt(_: int, __: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", spy)
    with pytest.raises(KeyboardInterrupt):
        render_video(short_run, tmp_path / "film.mp4", workers=2, progress=interrupt)
    assert len(started) == 2
    assert all(process.returncode is not None for process in started)
    assert list(tmp_path.iterdir()) == []


def test_footage_meets_the_plant_at_its_rows_and_halfway_between(short_run: Flight):
    plant = short_run.log.plant
    rows = np.array([10, 200, 777])
    at = make_footage(filmed(short_run), plant.t[rows])
    assert at.position == pytest.approx(plant.state[rows][:, POSITION])
    x = at.quaternion[:, 1]
    y = at.quaternion[:, 2]
    z = at.quaternion[:, 3]
    w = at.quaternion[:, 0]
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    assert up == pytest.approx(body_to_world(plant.state[rows][:, EULER])[:, :, 2])
    between = make_footage(filmed(short_run), 0.5 * (plant.t[rows] + plant.t[rows + 1]))
    assert between.position == pytest.approx(0.5 * (plant.state[rows] + plant.state[rows + 1])[:, POSITION])
    assert np.linalg.norm(between.quaternion, axis=1) == pytest.approx(np.ones(3))


def test_footage_knows_its_period_and_the_worst_margin_so_far(short_run: Flight):
    footage = make_footage(filmed(short_run), np.array([0.0, 0.049, 0.05, 3.0, 6.0]))
    assert footage.period.tolist() == [0, 0, 1, 60, len(short_run.log.control.t) - 1]
    assert footage.turned[-1] == pytest.approx(np.sum(0.05 * short_run.log.control.speeds, axis=0), rel=1e-2)
    findings = audit(short_run.log, short_run.limits)
    assert np.abs(footage.aim - footage.position).max() <= 0.6 * short_run.vehicle.arm_length + 1e-12
    for track, finding in zip(footage.margins, findings, strict=True):
        assert track.worst[-1] == pytest.approx(finding.worst_margin, nan_ok=True)


def test_the_last_second_shows_why_there_was_no_answer_and_that_the_fallback_went_on(short_run: Flight) -> None:
    long = "cannot hold together: " + "; ".join(["roll upper at +0.15 s .. +0.40 s by 0.8 deg"] * 6)
    controller = {**short_run.summary["controller"], "unrecovered": 40}
    footage = make_footage(filmed(short_run), np.array([4.9, 5.0, 6.0]))

    def headlines(sentence: str, advice: str) -> list[list[str]]:
        result = {"sentence": sentence, "advice": advice}
        run = filmed(recording(short_run, controller=controller, diagnosis=result))
        overlay = CaptionPainter(run, footage, width=1280, height=720)
        return [[text for text, _, _ in overlay._headlines(i)] for i in range(3)]

    before, first, last = headlines(long, "to try: more")
    assert not [text for text in before if "recovered" in text]
    shown = last[last.index("40 periods in fallback, never recovered") :]
    assert first[-len(shown) :] == shown
    assert " ".join(shown[1:]) == f"{long} to try: more"
    assert headlines("; ".join([long] * 20), "")[2][-1] == "... all of it is in summary.json"


def test_violated_limits_come_first_then_the_nearest_and_the_film_shows_how_many_more(short_run: Flight) -> None:
    """In the order of the file the one that is violated by metres stands last, and was never seen."""
    height = short_run.log.plant.state[-1, INDEX["z"]]
    wide = [Limit(name=f"wide_{j}", signal="z", upper=1000.0 + j) for j in range(7)]
    near = Limit(name="near", signal="z", upper=1.01 * height)
    reported = Limit(name="reported", signal="z", upper=0.01, required=False)
    low = Limit(name="low", signal="z", upper=0.5)

    def red(*limits: Limit) -> int:
        """How many pixels of the last frame the captions paint red."""
        run = filmed(judged_by(short_run, *limits))
        overlay = CaptionPainter(run, make_footage(run, np.array([6.0])), width=1280, height=720)
        picture = overlay.draw(np.full((720, 1280, 3), 128, np.uint8), 0)
        return int(np.count_nonzero((picture == rgb(ON_DARK.violated)).all(axis=-1)))

    limits = (*wide, near, reported, low)
    tracks = make_footage(filmed(judged_by(short_run, *limits)), np.array([6.0])).margins
    shown, rest = margin_rows(ranked_tracks(tracks), 0)
    assert [track.limit.name for track in shown] == ["low", "reported", "near", "wide_0", "wide_1", "wide_2"]
    assert rest == "and 4 more"
    assert red(*wide, near) == 0
    assert red(*limits) > 0


def test_limits_that_are_equally_near_stand_as_in_the_file(short_run: Flight) -> None:
    """Their bounds differ by rounding, as margins do from one processor to another."""
    rng = np.random.default_rng(0)
    names = ("zeta", "alpha", "mid")
    for _ in range(5):
        bounds = 100.0 * (1.0 + 3e-6 * rng.uniform(-1.0, 1.0, len(names)))
        limits = [Limit(name=name, signal="z", upper=bound) for name, bound in zip(names, bounds, strict=True)]
        limits.append(Limit(name="near", signal="z", upper=10.0))
        tracks = make_footage(filmed(judged_by(short_run, *limits)), np.array([6.0])).margins
        assert [track.limit.name for track in ranked_tracks(tracks)] == ["near", *names]
