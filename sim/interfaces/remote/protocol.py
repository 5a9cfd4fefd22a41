"""Events as JSON: metadata as it is, pictures as PNG and depth as float32, both in base64."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import imageio.v3 as iio
import numpy as np
from numpy.typing import NDArray

from data.files import parse_json
from sim.interfaces.controller import Event

VERSION: Final = 1
IMAGES: Final = ("frame", "depth_frame", "instance_segmentation_frame", "third_party_camera_frames")
DEFAULT_IMAGES: Final = ("frame",)


class ProtocolError(ValueError):
    """A request or reply that is not of the protocol; the message names what is wrong."""


def loads(text: bytes) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        ProtocolError: on anything else, NaN and infinity included.
    """
    try:
        value = parse_json(text.decode("utf-8"))
    except (ValueError, RecursionError) as error:  # numbers of thousands of digits too
        raise ProtocolError(f"the body is no JSON: {error}") from None
    if not isinstance(value, dict):
        raise ProtocolError(f"the body must be a JSON object, got {type(value).__name__}")
    return value


def dumps(value: Mapping[str, Any]) -> bytes:
    """Writes a JSON object; NumPy numbers become plain ones."""

    def plain(item: Any) -> Any:
        if isinstance(item, np.generic):
            return item.item()
        if isinstance(item, np.ndarray):
            return item.tolist()
        raise TypeError(f"{type(item).__name__} is no JSON")

    return json.dumps(value, default=plain, allow_nan=False).encode("utf-8")


def images_of(body: dict[str, Any]) -> tuple[str, ...]:
    """Takes the wanted images out of a request.

    Raises:
        ProtocolError: on a name outside `IMAGES`.
    """
    wanted = body.pop("images", DEFAULT_IMAGES)
    if not isinstance(wanted, Sequence) or isinstance(wanted, str):
        raise ProtocolError(f"images must be a list, got {str(wanted)[:80]!r}")
    unknown = [name for name in wanted if name not in IMAGES]
    if unknown:
        raise ProtocolError(f"unknown image {str(unknown[0])[:80]!r}; allowed: {', '.join(IMAGES)}")
    return tuple(wanted)


def _png(frame: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    iio.imwrite(buffer, frame, extension=".png")
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def _pixels(text: str) -> NDArray[np.uint8]:
    return np.asarray(iio.imread(io.BytesIO(base64.b64decode(text)), extension=".png"), dtype=np.uint8)


def encode_event(event: Event, images: Sequence[str]) -> dict[str, Any]:
    """An event as JSON values, with the images that are asked for."""
    out: dict[str, Any] = {"metadata": event.metadata}
    if "frame" in images:
        out["frame"] = _png(event.frame)
    if "depth_frame" in images:
        data = np.ascontiguousarray(event.depth_frame, dtype="<f4").tobytes()
        out["depth_frame"] = {"shape": list(event.depth_frame.shape), "float32": base64.b64encode(data).decode("ascii")}
    if "instance_segmentation_frame" in images:
        out["instance_segmentation_frame"] = _png(event.instance_segmentation_frame)
        out["color_to_object_id"] = [[list(color), name] for color, name in event.color_to_object_id.items()]
    if "third_party_camera_frames" in images:
        out["third_party_camera_frames"] = [_png(frame) for frame in event.third_party_camera_frames]
    return out


def decode_event(values: Mapping[str, Any]) -> Event:
    """The event again; images that were not asked for are empty arrays."""
    depth = values.get("depth_frame")
    metres = np.zeros((0, 0), dtype=np.float32)
    if depth is not None:
        metres = np.frombuffer(base64.b64decode(depth["float32"]), dtype="<f4").reshape(depth["shape"]).astype(np.float32)
    empty = np.zeros((0, 0, 3), dtype=np.uint8)
    colors = {(int(c[0]), int(c[1]), int(c[2])): str(name) for c, name in values.get("color_to_object_id", [])}
    segmentation = values.get("instance_segmentation_frame")
    return Event(
        metadata=dict(values["metadata"]),
        frame=_pixels(values["frame"]) if "frame" in values else empty,
        depth_frame=metres,
        instance_segmentation_frame=empty if segmentation is None else _pixels(segmentation),
        color_to_object_id=colors,
        third_party_camera_frames=[_pixels(text) for text in values.get("third_party_camera_frames", [])],
    )
