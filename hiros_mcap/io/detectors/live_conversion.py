"""Messages of other detectors as SkeletonGroups, one by one, while they come.

Each detector keeps its own skeleton, until it turns out that the cameras have different ones. Then
all get their union, as in a file.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

import hiros_schemas
from hiros_mcap.body.transforms import TransformTree
from hiros_mcap.errors import LogError
from hiros_mcap.io.camera_frames import add_transforms, is_read
from hiros_mcap.io.channels import HUMANS, TRANSFORM_TYPES, ChannelInfo, channels_of, info_of
from hiros_mcap.io.container.live_reader import Arriving, LiveReader
from hiros_mcap.io.container.records import Channel, Message, Schema
from hiros_mcap.io.detectors.conversion import (
    SKELETONS,
    TRANSFORMS,
    Conversion,
    InputChannel,
    Selection,
    is_of_other_detector,
    source_of,
)
from hiros_mcap.io.detectors.detector_reader import SeenPeople
from hiros_mcap.io.detectors.keypoint_messages import KEYPOINT_TYPES, is_keypoints, joint_model
from hiros_mcap.io.detectors.model_fitting import chosen_model
from hiros_mcap.io.detectors.rgb_keypoints import RgbRig
from hiros_mcap.io.detectors.skeleton_groups import SkeletonGroups
from hiros_mcap.io.ros_cdr import RosMessage
from hiros_mcap.io.ros_messages import SeenLenses
from hiros_mcap.rays.skeleton_rays import LENS, GuessedDepth, looking_at
from hiros_mcap.skeletons import SkeletonModel

_PROBED = 100
"""Messages of a channel that show nobody, after which it is taken to be of another use."""
_LAST_ID = 0xFFFF
"""Of a channel or schema. The input numbers its own from below."""
_NAMES = {SKELETONS: hiros_schemas.SKELETON_GROUP, TRANSFORMS: hiros_schemas.TF_MESSAGE}


class LiveConversion(Conversion):
    """Turns messages into those that hiros reads, in the order in which they come.

    Parameters
    ----------
    reader : knows the channels; gets those of the new messages.
    selects : says of a topic whether its skeletons are wanted.
    tree : poses of the cameras, of a file; None = the transforms that come.
    rays : topics, cameras and frames of 3D skeletons whose depth is guessed.
    """

    copies_images = False

    def __init__(
        self,
        reader: LiveReader,
        selects: Callable[[str], bool],
        tree: TransformTree | None = None,
        rays: Collection[str] = (),
    ) -> None:
        super().__init__(reader, Selection(selects=selects), (), {})
        self._guessed, self._rays = GuessedDepth({}, {}), frozenset(rays)
        self._seen_lenses = SeenLenses()
        seen, tree = self._seen_lenses, tree or TransformTree()
        self._rig = RgbRig(
            tree, "", seen.lenses, seen.faults, {}, guessed=self._guessed, changes=seen.changes
        )
        self._teaches: dict[int, tuple[str, ChannelInfo]] = {}
        """Channel -> what of the RGB cameras it tells."""
        self._live = reader
        self._read_as: dict[int, InputChannel | None] = {}
        """Channel -> how it is read, None = it stays as it is."""
        self._known = 0, True
        """Number of channels, and whether transforms may show humans."""
        self._human: set[int] = set()
        """Channels of humans that transforms show."""
        self._added: dict[tuple[str, str], int] = {}
        """Topic and type -> channel of the new messages."""

    @property
    def hint(self) -> str:
        """Why messages that look like skeletons are none, if no channel shows any; else ""."""
        waits = self._rig.models and self.rgb.rig is None
        return super().hint or ("; ".join(self._seen_lenses.faults.values()) if waits else "")

    def converted(self, messages: Arriving) -> Arriving:
        """Yield what messages become: themselves, if they are of no other detector."""
        for message in messages:
            for new in self._converted(message) if message else (None,):
                if new is not None:
                    self._learn(new)
                yield new
        for rest in self.rest():  # waited for another message when the input ended
            yield self._message(rest, Message(0, rest.log_time, b"", rest.log_time, 0), None)

    def _converted(self, message: Message) -> Iterator[Message]:
        source = self._source(message.channel_id)
        if source is None:
            yield message
            return
        topic = source.info.topic
        if self._rays and source.type == SKELETONS and topic not in self._guessed.models:
            with suppress(LogError):
                self._learn_guess(SkeletonGroups().read(source.message(message)))
        if topic in self._guessed.models:
            self._live.hide(message.channel_id)
        before = self._declined[topic]
        made = [self._message(new, message, source) for new in self.rewritten(source, message)]
        yield from made
        # Nobody needs the original of a channel that has become another one, as in a file.
        is_kept = source.type in KEYPOINT_TYPES or not made
        if is_kept and not source.is_native and message.channel_id not in self._live.hidden:
            yield message
        if self._declined[topic] > max(before, _PROBED) and topic not in self._layouts:
            self._read_as[message.channel_id] = None

    def _learn(self, message: Message) -> None:
        """Learn from transforms and lenses where cameras stand; raises LogError for damage."""
        ident = message.channel_id
        if ident not in self._teaches:
            info = info_of(self._live, ident)
            is_lens = info.has_type(hiros_schemas.CAMERA_INFO)
            self._teaches[ident] = "lens" if is_lens else "pose" if is_read(info) else "", info
        kind, info = self._teaches[ident]
        if kind == "pose" and not self._rig.tree.source:
            add_transforms(self._rig.tree, info.topic, message.data, message.log_time)
        elif kind == "lens":
            with suppress(LogError):
                source = source_of(self._live, info, selected=True).message(message)
                self._seen_lenses.take(
                    info.topic, message.log_time, source.cdr, lambda: source.fields
                )
        if kind and self.rgb.rig is None:
            self._stand()

    def _learn_guess(self, people: Iterable[SeenPeople]) -> None:
        """Learn whether people are of a camera that guesses depths, and where it looks."""
        for topic, model, frame in people:
            name = frame.frame_id.lstrip("/")
            is_named = not self._rays.isdisjoint({topic, name, frame.source})
            if is_named and name not in self._guessed.turns and np.isfinite(frame.positions).any():
                self._guessed.turns[name] = looking_at(frame.positions)
                self._guessed.models.setdefault(topic, model)
                self._rig.models.setdefault(topic, model)
                self._rig.lenses[name] = LENS
                self._stand()

    def _groups(self, people: Iterable[SeenPeople]) -> Iterator[RosMessage]:
        """Yield people as SkeletonGroups."""
        people = list(people)
        if self._rays:
            self._learn_guess(people)
        yield from super()._groups(people)

    def _stand(self) -> None:
        """Begin to triangulate when two RGB cameras have a lens and a place in one room."""
        tree = self._rig.tree
        frames = [name for name in self._rig.lenses if name in tree.frames]
        with suppress(LogError):
            if len(frames) > 1:
                self.rgb.rig = replace(self._rig, fixed_frame=tree.common_root(frames))

    def settle(self, model: SkeletonModel, tree: TransformTree) -> None:
        """Go on with the skeleton of the results and the transforms of the log, which is open now.

        Cameras that come later get that skeleton. The transforms grow with those that come.
        """
        self.target, self._rig = model, replace(self._rig, tree=tree)
        if self.rgb.rig is not None:
            self.rgb.rig = replace(self.rgb.rig, tree=tree)

    def unite(self, messages: Iterable[Message]) -> list[Message]:
        """Give skeletons the union of all models, from now on; return ``messages`` with it.

        Raises LogError if a channel's skeletons have too little in common with the others'.
        """
        self._read_as = {i: source for i, source in self._read_as.items() if source is not None}
        messages, groups = list(messages), SkeletonGroups()
        for message in messages:
            source = self._group_source(message.channel_id)
            with suppress(LogError):
                for people in groups.read(source.message(message)) if source else ():
                    self._models[people.topic] = people.model
        self.target = chosen_model("", self._models)
        return [again for message in messages for again in self._refitted(message)]

    def _refitted(self, message: Message) -> Iterator[Message]:
        """Yield a message of the preface with the target's skeleton."""
        source = self._group_source(message.channel_id)
        if source is None:
            yield message
            return
        for new in self.rewritten(source, message):
            yield self._message(new, message, source)

    def _message(self, new: RosMessage, message: Message, source: InputChannel | None) -> Message:
        """Return a new message, on the old channel where that has the type."""
        topic, kind = (source.info.topic, source.type) if source else ("", "")
        if source and new.type == SKELETONS != kind:
            known = self._layouts.get(topic, {})
            self._layouts[topic] = {**known, new.topic: self._models[new.topic]}
        if source and source.is_native and (new.type, new.topic) == (kind, topic):
            ident = message.channel_id
        else:
            ident = self._channel_of(new)
            self._live.counts[ident] += 1
            if kind == TRANSFORMS:
                self._human.add(ident)
            elif source and kind not in KEYPOINT_TYPES:
                self._live.hide(message.channel_id)
        return replace(message, channel_id=ident, log_time=new.log_time, data=bytes(new.data))

    def _channel_of(self, new: RosMessage) -> int:
        key = new.topic, new.type
        if key not in self._added:
            ident = self._added[key] = _LAST_ID - len(self._added)
            name = _NAMES[new.type]
            text = hiros_schemas.text(name).encode()
            self._live.define(
                Schema(id=ident, name=name, encoding="ros2msg", data=text),
                Channel(ident, new.topic, "cdr", {}, ident),
            )
        return self._added[key]

    def _source(self, ident: int) -> InputChannel | None:
        """Return how a channel is read."""
        if ident not in self._read_as:
            self._read_as[ident] = self._found(info_of(self._live, ident))
        source = self._read_as[ident]
        if source is not None and source.type == TRANSFORMS:
            source = source._replace(selected=self._may_show_humans())
            if source.is_native and not source.selected:
                return None
        return source

    def _found(self, info: ChannelInfo) -> InputChannel | None:
        selected = self._selection.selects(info.topic)
        is_group = info.type == SKELETONS
        is_transforms = info.type in TRANSFORM_TYPES
        shows_people = selected and (is_group or is_of_other_detector(info))
        if not (shows_people or is_transforms):
            return None
        try:
            source = source_of(self._live, info, selected=selected)
        except LogError:  # of another use
            return None
        self._sources[info.id] = source
        if is_keypoints(info):
            self._rig.models[info.topic] = joint_model(info)
        # Whoever comes when results have their skeleton gets that one.
        stays = is_group and source.is_native and self.target is None and not self._rays
        return None if stays else source

    def _group_source(self, ident: int) -> InputChannel | None:
        """Return how the SkeletonGroups of a channel are read; None for other channels."""
        info = info_of(self._live, ident)
        if info.type != SKELETONS or not self._selection.selects(info.topic):
            return None
        source = source_of(self._live, info, selected=True)
        return source if source.is_native else None

    def _may_show_humans(self) -> bool:
        """Whether transforms are looked at: something hints at humans, or nothing else shows any.

        Every log has transforms.
        """
        if self._known[0] != len(self._live.channels):
            infos = channels_of(self._live)
            others = any(
                info.type == SKELETONS
                and self._selection.selects(info.topic)
                and info.id not in self._human
                for info in infos
            )
            hints = any(info.schema.startswith(HUMANS) for info in infos)
            self._known = len(infos), hints or not others
        return self._known[1]
