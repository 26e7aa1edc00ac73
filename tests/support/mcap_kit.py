"""MCAP files read by mcap and protobuf alone: no code of ours, and none of Foxglove's."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation


@dataclass
class ReadMcap:
    """The messages of a file by topic, each with its time [ns]."""

    messages: dict[str, list[tuple[int, Any]]] = field(default_factory=lambda: defaultdict(list))
    schemas: dict[str, str] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    chunks: int = 0

    def of(self, topic: str) -> list[Any]:
        """Return the messages of a topic."""
        return [message for _, message in self.messages[topic]]


def read_mcap(path: Path) -> ReadMcap:
    found, kinds = ReadMcap(), {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        found.chunks = len(summary.chunk_indexes)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            found.schemas[channel.topic] = schema.name
            if channel.message_encoding == "json":
                told = json.loads(message.data)
            else:
                if schema.id not in kinds:
                    kinds[schema.id] = protobuf_kind(schema.name, schema.data)
                told = kinds[schema.id].FromString(message.data)
            found.messages[channel.topic].append((message.log_time, told))
        for record in reader.iter_metadata():
            found.metadata[record.name] = record.metadata
    return found


def protobuf_kind(name: str, schema: bytes) -> Any:
    """Return the class of a message, made of the schema that stands in the file."""
    pool = descriptor_pool.DescriptorPool()
    for each in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(each)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def turn_of(quaternion: Any) -> Rotation:
    return Rotation.from_quat([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


def xyz(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])


def distances_to(update: Any, points: np.ndarray) -> np.ndarray:
    """Return the distances of points (n, 3) to the nearest surface of a scene's bodies [m].

    Distances to boxes and cylinders are absolute values of signed distance functions.
    """
    nearest = np.full(len(points), np.inf)
    for entity in update.entities:
        if entity.id in ("goal", "path"):
            continue
        assert entity.frame_id == "world"
        for kind in ("cubes", "cylinders", "spheres"):
            for body in getattr(entity, kind):
                local = turn_of(body.pose.orientation).inv().apply(points - xyz(body.pose.position))
                half = 0.5 * xyz(body.size)
                if kind == "spheres":
                    away = np.linalg.norm(local, axis=1) - half[0]
                else:
                    if kind == "cylinders":
                        radial = np.hypot(local[:, 0], local[:, 1]) - half[0]
                        over = np.stack([radial, np.abs(local[:, 2]) - half[2]], axis=1)
                    else:
                        over = np.abs(local) - half
                    outside = np.linalg.norm(np.maximum(over, 0.0), axis=1)
                    away = outside + np.minimum(over.max(axis=1), 0.0)
                nearest = np.minimum(nearest, np.abs(away))
    return nearest
