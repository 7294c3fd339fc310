"""The harness itself harms nothing: what it damages is in its own folder, and it writes through no link."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest
from safety_mutations import FILES, mutate_campaign, put


def test_a_file_is_put_in_place_of_a_link_and_never_through_it(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "link").symlink_to("mine")
    put(tmp_path / "link", b"new")
    assert (tmp_path / "mine").read_text() == "mine"
    assert not (tmp_path / "link").is_symlink()
    assert (tmp_path / "link").read_text() == "new"


@pytest.mark.parametrize("seed", range(20))
def test_what_links_lead_to_is_left_alone_however_often_it_is_damaged(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    (tmp_path / "decoy").write_text("mine")
    for name in FILES:
        (tmp_path / "hurt").mkdir(exist_ok=True)
        (tmp_path / "hurt" / name).symlink_to("../decoy")
        for _ in range(20):
            mutate_campaign(tmp_path / "hurt", rng)  # finds no file that it may damage
        assert (tmp_path / "hurt" / name).is_symlink()
    assert (tmp_path / "decoy").read_text() == "mine"
    shutil.rmtree(tmp_path / "hurt")
    assert [path.name for path in tmp_path.iterdir()] == ["decoy"]
