"""The messages for wrong fields wherever they are: in unions of tables, in lists of them, in optional ones."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import pytest
from annotated_types import Len
from pydantic import Discriminator, Field, Tag, ValidationError, model_validator

from scenarios.schema.base import Pair, Spec
from scenarios.schema.problems import describe, find


class Gust(Spec):
    """A gust."""

    type: Literal["gust"] = Field(description="kind")
    at: float = Field(default=0.0, description="[s]")
    gust: float = Field(default=1.0, description="[m/s] its name is also the tag")


class Loss(Spec):
    """A rotor is lost."""

    type: Literal["loss"] = Field(description="kind")
    rotor: Annotated[int, Field(ge=1, le=4)] = Field(description="which")
    shares: dict[Literal["a", "b"], float] = Field(default={}, description="by name")
    inner: Annotated[Gust | Switch, Field(discriminator="type")] | None = Field(default=None, description="within")

    @model_validator(mode="after")
    def _check(self) -> Loss:
        if self.rotor == 2:
            raise ValueError("rotor must not be 2")
        return self


class Switch(Spec):
    """Another kind."""

    type: Literal["switch"] = Field(description="kind")
    name: str = Field(description="what it is called")
    points: Annotated[list[Pair], Len(2)] = Field(default=[[0.0, 0.0], [1.0, 1.0]], description="[m]")


def kind(value: object) -> str:
    return value.get("type", "gust") if isinstance(value, dict) else "gust"


class Root(Spec):
    """The file."""

    events: list[Annotated[Gust | Loss | Switch, Field(discriminator="type")]] = Field(default=[], description="acts")
    wind: Annotated[Gust | Loss, Field(discriminator="type")] | None = Field(default=None, description="one or none")
    course: Annotated[Annotated[Gust, Tag("gust")] | Annotated[Loss, Tag("loss")], Discriminator(kind)] = Field(
        default=Gust(type="gust"), description="one, distinguished by a function"
    )
    texts: Annotated[list[str], Len(2, 2)] = Field(default=["a", "b"], description="two")
    loose: Gust | float = Field(default=1.0, description="no tag")
    word: Annotated[str, Field(min_length=2, max_length=3)] = Field(default="ab", description="short")
    step: Annotated[float, Field(multiple_of=0.5, lt=9.0)] = Field(default=1.0, description="[m]")


Loss.model_rebuild()


def problems_of(data: dict[str, Any]) -> list[str]:
    with pytest.raises(ValidationError) as caught:
        Root.model_validate(data)
    return [describe(details, data, Root) for details in caught.value.errors(include_url=False)]


TYPES = "must be one of 'gust', 'loss' in its field type; got"
AT_X = {"type": "gust", "at": "x"}
LOSS = {"type": "loss", "rotor": 1}
WRONG: list[tuple[dict[str, Any], list[str]]] = [
    ({"events": [{"type": "gust", "gust": "x"}]}, ["events.0.gust must be a number; got 'x'"]),
    ({"events": [LOSS, {"type": "gust", "at": "x"}]}, ["events.1.at must be a number; got 'x'"]),
    (
        {"events": [{"type": "loss", "rotr": 1}]},
        [
            "events.0.rotor is missing",
            "events.0.rotr is not a field of the scenario file; did you mean 'rotor'? "
            "(there are: type, rotor, shares, inner)",
        ],
    ),
    (
        {"events": [{"type": "los"}]},
        ["events.0 must be one of 'gust', 'loss', 'switch' in its field type; got 'los'; did you mean 'loss'?"],
    ),
    ({"events": [{"at": 1.0}]}, ["events.0 must be a table with a field type; got None"]),
    ({"events": [3]}, ["events.0 must be a table; got 3"]),
    ({"events": [{"type": "loss", "rotor": 2}]}, ["events.0.rotor must not be 2"]),
    ({"events": [{**LOSS, "shares": {"c": 1.0}}]}, ["events.0.shares.c must be one of 'a' or 'b'; got 'c'"]),
    ({"events": [{**LOSS, "shares": {"a": "x"}}]}, ["events.0.shares.a must be a number; got 'x'"]),
    (
        {"events": [{**LOSS, "inner": {"type": "gust", "gusts": 1.0}}]},
        [
            "events.0.inner.gusts is not a field of the scenario file; did you mean 'gust'? "
            "(there are: type, at, gust)",
        ],
    ),
    (
        {"events": [{"type": "switch", "name": "on", "points": [[1.0]]}]},
        [
            "events.on.points.0 must be a list of 2 numbers; got [1.0]",
        ],
    ),
    (
        {"events": [{"type": "switch", "name": "on", "points": [[1.0, 2.0]]}]},
        ["events.on.points must be of 2 or more entries; got [[1.0, 2.0]]"],
    ),
    ({"wind": {"type": "gust", "at": "x"}}, ["wind.at must be a number; got 'x'"]),
    ({"wind": {"type": "gst"}}, [f"wind {TYPES} 'gst'; did you mean 'gust'?"]),
    ({"wind": 3}, ["wind must be a table; got 3"]),
    ({"course": {"type": "gust", "at": "x"}}, ["course.at must be a number; got 'x'"]),
    ({"course": {"type": "loss"}}, ["course.rotor is missing"]),
    ({"course": {"type": "lost"}}, [f"course {TYPES} 'lost'; did you mean 'loss'?"]),
    ({"texts": ["a"]}, ["texts must be a list of 2 texts; got ['a']"]),
    ({"word": "a"}, ["word must be a text of 2 or more characters; got 'a'"]),
    ({"word": "abcd"}, ["word must be a text of 3 or fewer characters; got 'abcd'"]),
    ({"step": 0.3}, ["step must be a multiple of 0.5; got 0.3"]),
    ({"step": 9.0}, ["step must be < 9.0; got 9.0"]),
    (
        {"loose": {"type": "gust", "at": "x"}},
        ["loose.at must be a number; got 'x'", f"loose must be a number; got {AT_X}"],
    ),
]


@pytest.mark.parametrize(("data", "lines"), WRONG, ids=[lines[0].partition(";")[0] for _, lines in WRONG])
def test_a_wrong_field_is_named_as_one_would_write_it(data: dict[str, Any], lines: list[str]) -> None:
    assert problems_of(data) == lines


def test_labels_of_pydantics_own_lead_to_the_kind_they_name() -> None:
    data = {"events": [{"type": "loss"}]}
    place = find(("events", 0, "loss"), data, Root)
    assert place.names == ("events", "0")
    assert [each.type for each in place.kinds] == [Loss]
    either = find(("events", 0), data, Root)
    assert [each.type for each in either.kinds] == [Gust, Loss, Switch]
    assert either.fields == ("type", "at", "gust", "rotor", "shares", "inner", "name", "points")
