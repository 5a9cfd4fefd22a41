"""Schemas for strict servers: closed, everything required, valid JSON schema, and still those of the model."""

from __future__ import annotations

from enum import Enum
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, Field, RootModel

from proprio_mllm.backends.structured import strict_schema


class Arm(Enum):
    LEFT = "left"
    RIGHT = "right"


class Pick(BaseModel):
    kind: Literal["pick"]
    title: str = Field(description="which object", min_length=1)


class Wait(BaseModel):
    kind: Literal["wait"]
    default: int = 3


class Plan(BaseModel):
    steps: list[Annotated[Pick | Wait, Field(discriminator="kind")]]
    arm: Arm | None = None
    best: Pick = Field(description="the best one")
    after: list[Plan] = []


class Nothing(BaseModel):
    pass


class Free(BaseModel):
    values: dict[str, int]


def objects(schema: Any) -> list[dict[str, Any]]:
    found = []
    if isinstance(schema, dict):
        found += [schema] if "properties" in schema and schema.get("type") == "object" else []
        found += [one for value in schema.values() for one in objects(value)]
    if isinstance(schema, list):
        found += [one for value in schema for one in objects(value)]
    return found


def test_everything_is_closed_and_required() -> None:
    schema = strict_schema(Plan)
    assert schema["type"] == "object"
    assert set(schema["properties"]) == {"steps", "arm", "best", "after"}
    found = objects(schema)
    assert len(found) == 4
    for one in found:
        assert one["additionalProperties"] is False
        assert one["required"] == list(one["properties"])
    # fields that have the names of keywords stay
    assert set(schema["$defs"]["Pick"]["properties"]) == {"kind", "title"}
    assert set(schema["$defs"]["Wait"]["properties"]) == {"kind", "default"}
    text = str(schema)
    assert all(word not in text for word in ("oneOf", "discriminator", "minLength", "'default': 3"))


def test_nothing_stands_beside_a_reference() -> None:
    best = strict_schema(Plan)["properties"]["best"]
    assert best == {"anyOf": [{"$ref": "#/$defs/Pick"}], "description": "the best one"}


def test_the_models_own_schema_is_left_alone() -> None:
    before = str(Plan.model_json_schema())
    strict_schema(Plan)
    assert str(Plan.model_json_schema()) == before


def test_an_empty_object() -> None:
    assert strict_schema(Nothing) == {"type": "object", "properties": {}, "required": [], "additionalProperties": False}


@pytest.mark.parametrize(
    ("model", "message"),
    [(RootModel[list[int]], "a strict schema is an object, got 'array'"), (Free, r"Free\.values: a mapping with free keys")],
)
def test_what_cannot_be_strict(model: type[BaseModel], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        strict_schema(model)
