"""JSON schemas that servers with strict structured output accept.

Strict servers want every object closed and every property required, and refuse some of JSON schema; what they refuse is left
out, because whoever asked validates the reply anyway. An optional property becomes one that must be there and may be null, so a
model with defaults should allow None. Paper: none (engineering).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from pydantic import BaseModel

#: Hints for readers, and limits that strict servers do not hold.
_LEFT_OUT: Final = frozenset({"title", "default", "examples", "discriminator", "minLength", "maxLength", "uniqueItems"})


def strict_schema(model: type[BaseModel]) -> dict[str, Any]:
    """The schema of a model, closed and with every property required.

    Raises:
        ValueError: when the model cannot be strict: it is no object, or holds a mapping with free keys.
    """
    raw = model.model_json_schema()
    definitions = raw.pop("$defs", {})
    if "$ref" in raw:  # of a model that holds itself
        raw = {**definitions[raw["$ref"].rpartition("/")[2]]}
    if raw.get("type") != "object":
        raise ValueError(f"{model.__name__}: a strict schema is an object, got {raw.get('type')!r}")
    schema = _strict(raw, model.__name__)
    if definitions:
        schema["$defs"] = {name: _strict(one, f"{model.__name__}.{name}") for name, one in definitions.items()}
    return schema


def _strict(schema: Mapping[str, Any], where: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in schema.items():
        if key in _LEFT_OUT or key in ("properties", "required", "additionalProperties"):
            continue
        if key == "oneOf":
            key = "anyOf"
        if key in ("items", "not") and isinstance(value, Mapping):
            value = _strict(value, where)
        elif key in ("anyOf", "allOf", "prefixItems"):
            value = [_strict(one, where) for one in value]
        found[key] = value
    if schema.get("type") == "object":
        if not schema.get("properties") and schema.get("additionalProperties", False) is not False:
            raise ValueError(f"{where}: a mapping with free keys has no strict schema")
        properties = schema.get("properties", {})
        found["properties"] = {name: _strict(one, f"{where}.{name}") for name, one in properties.items()}
        found["required"] = list(properties)
        found["additionalProperties"] = False
    if "$ref" in found and len(found) > 1:  # nothing may stand beside a reference
        return {"anyOf": [{"$ref": found.pop("$ref")}], **found}
    return found
