"""``TFMessage`` over real DDS, as a message that has wheels: each marker carries one transform."""

from __future__ import annotations

from geometry_msgs.msg import Point, Transform, TransformStamped, Vector3
from visualization_msgs.msg import Marker
from visualization_msgs.msg import MarkerArray as TFMessage


def _read(message: TFMessage) -> list[TransformStamped]:
    transforms = []
    for each in message.markers:
        place = each.pose.position
        moved = Transform(translation=Vector3(x=place.x, y=place.y, z=place.z), rotation=each.pose.orientation)
        transforms.append(TransformStamped(header=each.header, child_frame_id=each.ns, transform=moved))
    return transforms


def _write(message: TFMessage, transforms: list[TransformStamped]) -> None:
    message.markers = [Marker(header=each.header, ns=each.child_frame_id) for each in transforms]
    for marker, each in zip(message.markers, transforms, strict=True):
        place = each.transform.translation
        marker.pose.position = Point(x=place.x, y=place.y, z=place.z)
        marker.pose.orientation = each.transform.rotation


TFMessage.transforms = property(_read, _write)
