"""The summary of a run: cameras, people, times, and notes on what a user should know."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from hiros_mcap.calibrate.gauge import placement_error
from hiros_mcap.events import (
    CAMERA_BACK,
    CAMERA_DISPLACED,
    COMMON,
    COUNTED,
    MIRROR_SEEN,
    RESIDUAL,
    SAME_TIME,
    TOO_LATE,
    Event,
    Events,
    counted,
)
from hiros_mcap.io.channels import OUTPUT_PREFIX
from hiros_mcap.io.log import DAMAGED, FAR_FUTURE, STALE, CameraChannel, Log, Reading
from hiros_mcap.running.clock_alignment import clock_notes, clock_warnings
from hiros_mcap.running.observe import Observer, Presence
from hiros_mcap.running.preparation import Prepared
from hiros_mcap.running.summary import (
    CameraSummary,
    DelaySummary,
    LimbSummary,
    PersonSummary,
    PlacementSummary,
    PoseSummary,
    ScatterSummary,
    StageTime,
    Summary,
)
from hiros_mcap.running.write import unmatched_globs
from hiros_mcap.skeletons import SkeletonModel
from hiros_mcap.stages.fuse.residuals import FEWEST, medians, ratios
from hiros_mcap.stages.track.likeness import DISPLACED
from hiros_mcap.systems import Run, sections_of
from hiros_mcap.wording import quantity

_IN_TABLES = {"flip", "outlier", TOO_LATE, SAME_TIME}
"""Kinds of events that a summary's tables count."""
_LARGEST_LOSS = 0.05
_REMEDIES = {
    SAME_TIME: "let the detector stamp each image with its own time",
    TOO_LATE: "let messages wait longer with --set {wait}, or correct the camera's clock with "
    "--clock CAMERA=SECONDS",
    DAMAGED: "look for the fault at its source",
    FAR_FUTURE: "correct the recorder's clock",
}
"""Reason why messages were skipped -> what to do."""
_DISPLACED = {
    CAMERA_DISPLACED: "calibrate the cameras anew: hiros calibrate people",
    MIRROR_SEEN: "cover the mirror",
}
"""Event of a camera that shows people elsewhere than the others do -> what to do."""
_LARGE = 1.4  # times as far as expected
_WORSE = 1.2  # a joint is named if it is so many times worse than its camera
_TOGETHER = 0.6  # share in common from which the camera as a whole is off


@dataclass(frozen=True, slots=True)
class Report:
    """Makes the summary of a run; it can be asked again while the run goes on."""

    prepared: Prepared
    run: Run
    observer: Observer
    reading: Reading

    @property
    def log(self) -> Log:
        """The log that is read, as far as it is known."""
        return self.reading.log

    def summary(self, target: str | None) -> Summary:
        """Return everything that is known so far."""
        start, end = self.log.span
        watch = self.prepared.watch
        people, chain, cpu = self.observer.people, self.observer.chain, watch.cpu
        calibrated = ("calibrate",) if self.prepared.poses.cameras else ()
        steps = [name for name in ("open", "read", *calibrated, *chain, "write") if name in cpu]
        cameras = tuple(map(self._camera, self.log.cameras))
        scatters = tuple(scatter_by_camera(self.run.events, self.run.model))
        return Summary(
            source=str(self.log.path),
            target=target,
            log_s=(end - start) * 1e-9,
            wall_s=time.perf_counter() - watch.started,
            waited_s=self.log.reader.waited_s,
            system=self.run.system,
            settings=str(self.prepared.options.settings or ""),
            delay=self._delay(),
            cameras=cameras,
            poses=tuple(map(self._pose, self.prepared.poses.cameras)),
            placement=self._placement(),
            scatter=scatter_of(self.run.events),
            scatters=scatters,
            people=tuple(self._person(i, people[i]) for i in sorted(people)),
            stages=tuple(StageTime(name, cpu[name]) for name in steps),
            written={f"{OUTPUT_PREFIX}/{name}": self.observer.written[name] for name in chain},
            losses=self.log.recovery.loss if self.log.recovery else "",
            warnings=tuple(self._warnings(cameras)),
            notes=(*self._all_notes(), *scatter_notes(scatters)),
        )

    def _pose(self, camera: PoseSummary) -> PoseSummary:
        """Return what is known of a pose; it is doubtful from when on the people contradict it."""
        event = next((e for e in self._displacements() if e.source == camera.name), None)
        if event is None or camera.verdict == "impossible":
            return camera
        reason = f"{event.detail} from {self._seconds(event):.1f} s on"
        return replace(camera, verdict="doubtful", reason=reason)

    def _displacements(self) -> list[Event]:
        """Return the first event of each camera that shows people elsewhere than others do."""
        displaced = sorted(
            (e for e in self.run.events.log if e.kind in _DISPLACED), key=attrgetter("stamp")
        )
        return list(reversed({(e.source, e.kind): e for e in reversed(displaced)}.values()))

    def _seconds(self, event: Event) -> float:
        """Return when something happened, s after the start of the log."""
        return max(0.0, (event.stamp - self.log.span[0]) * 1e-9)

    def _delay(self) -> DelaySummary | None:
        """Return how late the results of a causal run were."""
        observer = self.observer
        if not (observer.delays and self.prepared.is_causal):
            return None
        return DelaySummary(observer.delay(50), observer.delay(95))

    def _placement(self) -> PlacementSummary | None:
        """Return how uncertain the placement of the rig is."""
        if len(self.prepared.poses.cameras) < 2 or self.prepared.poses.from_nothing:
            return None
        error = placement_error(self.run.cameras, self.run.known.to_given)
        return PlacementSummary(1000.0 * error.metres, error.degrees) if error else None

    def _camera(self, camera: CameraChannel) -> CameraSummary:
        """Return what became of a camera's messages."""
        counts, hertz = self.run.events.counts, self.observer.rates
        account = self.reading.accounts[camera.channel.topic]
        sources = sorted(camera.sources.values())
        rates = [hertz[source].hertz for source in sources if source in hertz]
        # Cameras that share messages: the one that lost most, since each lost a part of them.
        lost = {why: max(counts[why, s] for s in sources) for why in (TOO_LATE, SAME_TIME)}
        lost = {why: n for why, n in lost.items() if n}
        return CameraSummary(
            name=", ".join(sources),
            topic=camera.channel.topic,
            rate_hz=sum(rates) / len(rates) if rates else math.nan,
            messages=account.read,
            used=account.used - sum(lost.values()),
            skipped={**account.skipped, **lost},
            flips=sum(counts["flip", source] for source in sources),
            outliers=sum(counts["outlier", source] for source in sources),
            clock=tuple(fault for fault in self.prepared.clocks.faults if fault.camera in sources),
        )

    def _person(self, person: int, presence: Presence) -> PersonSummary:
        return PersonSummary(
            id=person,
            first_ns=presence.first,
            last_ns=presence.last,
            frames=presence.frames,
            cameras=self.observer.cameras_of(person),
            predicted=presence.predicted,
            limbs=self._limbs(person),
        )

    def _limbs(self, person: int) -> LimbSummary | None:
        if "optimized" not in self.observer.chain:
            return None
        if limbs := self.run.limbs.people.get(person):
            variation = {name: limb.deviation / limb.length for name, limb in limbs.items()}
            worst = max(variation, key=lambda name: variation[name])
            frames = max(limb.frames for limb in limbs.values())
            median = float(np.median(list(variation.values())))
            return LimbSummary(frames, median, variation[worst], worst, accepted=True)
        for event in reversed(self.run.events.log):
            if event.kind == "calibration rejected" and event.person == person:
                return LimbSummary(0, math.nan, math.nan, "", accepted=False, reason=event.detail)
        return None

    def _longer_wait(self, camera: CameraSummary) -> str:
        """Return the parameter, and a value, with which a camera's messages come in time."""
        if self.prepared.is_causal:
            needed = [s for name, s in self.prepared.clocks.needed.items() if name in camera.name]
            return f"input.max_delay={max(needed, default=1.0):.2f}"
        stage = "track" if "track" in sections_of(self.run.system) else "associate"
        return f"{stage}.reorder=3"

    def _warnings(self, cameras: Sequence[CameraSummary]) -> Iterator[str]:
        """Yield what makes the result doubtful or incomplete, with the remedy; losses first."""
        if self.log.losses:
            damaged = "is damaged" if self.log.recovery else "was damaged before it was recovered"
            yield f"the recording {damaged}; {self.log.losses}"
        few: list[str] = []
        for camera in cameras:
            # A repeat of old skeletons holds nothing that could be lost.
            lost = {reason: n for reason, n in camera.skipped.items() if reason != STALE}
            if sum(lost.values()) > _LARGEST_LOSS * camera.messages:
                yield _loss(camera, lost, self._longer_wait(camera))
                continue
            few += [f"{camera.topic}: {n} {why}" for why, n in lost.items() if why != DAMAGED]
        if few:
            yield f"a few messages were not used: {'; '.join(few)}"
        for account in self.reading.accounts.values():
            if account.first_error:
                n = account.skipped[DAMAGED]
                yield (
                    f"{account.topic}: {quantity(n, 'faulty message')} left out; the first: "
                    f"{account.first_error}. Look for the fault at its source; --strict refuses it"
                )
        yield from self._untimed()
        yield from self._distortions(cameras)
        yield from clock_warnings(self.prepared.clocks.faults, self.log.span[0])
        found = bool(self.observer.people)
        yield from self.prepared.poses.warnings()
        yield from self._displaced()
        yield from self.reading.warnings
        if not found:
            yield from self._nobody()

    def _untimed(self) -> Iterator[str]:
        """Yield that log times are used, if many messages have no time of their own."""
        accounts = self.reading.accounts.values()
        untimed = [a for a in accounts if a.untimed > _LARGEST_LOSS * a.read]
        if untimed:
            n, read = sum(a.untimed for a in untimed), sum(a.read for a in untimed)
            yield (
                f"{', '.join(a.topic for a in untimed)}: {n} of {quantity(read, 'message')} have "
                "no time, or one before 1970; hiros used their log times instead, which vary with "
                "the delays of detectors and network; fill in header.stamp"
            )

    def _displaced(self) -> Iterator[str]:
        """Yield which cameras show people elsewhere than the others do."""
        events, displaced = self.run.events, self._displacements()
        for event in displaced:
            n = events.counts[DISPLACED, event.source]
            if len(displaced) == 1:  # of two cameras that disagree, copies of both are left out
                n = events.total(DISPLACED)
            left_out = f"hiros left out {quantity(n, 'such detection')}"
            done = left_out if n else "its pose is not known"
            yield (
                f"{event.source} {event.detail}. From {self._seconds(event):.1f} s on {done}; "
                f"{_DISPLACED[event.kind]}"
            )

    def _displaced_for_a_while(self) -> Iterator[str]:
        """Yield which cameras did so, and do no longer: the first time, and how often later."""
        times: dict[str, list[Event]] = {}
        for event in sorted(self.run.events.log, key=attrgetter("stamp")):
            if event.kind == CAMERA_BACK:
                times.setdefault(event.source, []).append(event)
        for source, (first, *later) in times.items():
            again = f", and {quantity(len(later), 'time')} more" if later else ""
            yield f"{source} {first.detail}, from {self._seconds(first):.1f} s on{again}"

    def _distortions(self, cameras: Sequence[CameraSummary]) -> Iterator[str]:
        """Yield which cameras often show people distorted."""
        for channel, camera in zip(self.log.cameras, cameras, strict=True):
            counts = self.run.events.counts
            n = sum(counts["distorted", source] for source in channel.sources.values())
            if n > _LARGEST_LOSS * camera.messages:
                yield (
                    f"{camera.topic}: {quantity(n, 'detection')} of {camera.messages} messages "
                    "contradict the limb lengths of people behind others and were left out; see "
                    "them with hiros view --layout cameras"
                )

    def _by_camera(self, kind: str) -> str:
        """Return in brackets how many of what was counted are of which camera, if any is named."""
        counts = self.run.events.counts.items()
        named = {source: n for (counted_kind, source), n in counts if counted_kind == kind}
        if "" in named or len(self.log.cameras) < 2:
            return ""
        if len(named) == 1:
            return f" (all of {next(iter(named))})"
        return f" ({', '.join(f'{named[source]} of {source}' for source in sorted(named))})"

    def _nobody(self) -> Iterator[str]:
        """Yield why nobody was found in detections of somebody."""
        reasons = list(self.observer.sample.reasons())
        if not reasons and self.observer.sample.frames:
            total = self.run.events.total
            kinds = [kind for kind, (noun, _) in COUNTED.items() if noun == "detection"]
            commonest = max(kinds, key=total)
            why = f": {counted(commonest, total(commonest))}" if total(commonest) else ""
            reasons = [
                f"nobody was found, though the cameras report people{why}; `hiros info` shows "
                "whether the cameras' poses and the skeletons make sense"
            ]
        yield from reasons

    def _all_notes(self) -> Iterator[str]:
        """Yield what nobody asked for but should know."""
        yield from unmatched_globs(self.log, self.prepared.options)
        yield from self.prepared.poses.notes(found=bool(self.observer.people))
        yield from self._displaced_for_a_while()
        yield from self.reading.remarks
        for account in self.reading.accounts.values():
            yield from account.notes(self.log.model.marker_names)
        total = self.run.events.total
        for kind in sorted({kind for kind, _ in self.run.events.counts} - _IN_TABLES):
            yield f"{counted(kind, total(kind))}{self._by_camera(kind)}"
        windows = self.run.config.optimize.calibration_windows
        measured = self.run.limbs.people or total("calibration rejected")
        optimized = self.observer.people and "optimized" in self.observer.chain
        if windows and optimized and not measured:
            yield "limb lengths not calibrated: nobody was seen in the calibration windows"
        yield from clock_notes(self.prepared.clocks.faults, self.log.span[0])


def _loss(camera: CameraSummary, lost: Mapping[str, int], wait: str) -> str:
    """Return in words that much of a camera was not used, and the remedy.

    ``lost`` counts by reason. ``wait`` is a parameter that lets messages wait long enough.
    """
    worst = max(lost, key=lambda reason: lost[reason])
    reasons = ", ".join(f"{n} {reason}" for reason, n in lost.items())
    share = f"{100 * sum(lost.values()) / camera.messages:.0f} %"
    return (
        f"{camera.topic}: {share} of {quantity(camera.messages, 'message')} not used ({reasons}); "
        f"{_REMEDIES[worst].format(wait=wait)}"
    )


def scatter_of(events: Events) -> float:
    """Return how many times as large as expected all residuals are; NaN if there are none."""
    residuals = [counts for (kind, _), counts in events.histograms.items() if kind == RESIDUAL]
    if not residuals:
        return math.nan
    return float(ratios(sum(counts.sum(axis=0) for counts in residuals)[None])[0])


def scatter_by_camera(events: Events, model: SkeletonModel) -> Iterator[ScatterSummary]:
    """Yield the same of each camera, by name."""
    for (kind, name), counts in sorted(events.histograms.items()):
        if kind != RESIDUAL:
            continue
        (ratio,) = ratios(counts.sum(axis=0, keepdims=True)).tolist()
        (common,) = medians(events.histograms[COMMON, name], FEWEST).tolist()
        joints = np.nan_to_num(ratios(counts))
        worst = int(joints.argmax())
        is_known = joints[worst] > 0
        yield ScatterSummary(
            name=name,
            ratio=ratio,
            worst_joint=model.marker_names[worst] if is_known else "",
            worst_ratio=float(joints[worst]) if is_known else math.nan,
            common=common,
        )


def scatter_notes(cameras: Sequence[ScatterSummary]) -> Iterator[str]:
    """Yield whose detections contradict the model, and what to do."""
    for camera in cameras:
        if not camera.ratio >= _LARGE:
            continue
        joint = ""
        if camera.worst_ratio > _WORSE * camera.ratio:
            joint = f" ({camera.worst_joint} {camera.worst_ratio:.1f} times)"
        yield (
            f"the detections of {camera.name} scatter {camera.ratio:.1f} times as much as the "
            f"model expects{joint}; the standard deviations of the result allow for it; "
            f"{_remedy(camera)}"
        )


def _remedy(camera: ScatterSummary) -> str:
    if camera.common > _TOGETHER:
        return "all joints are off together: check its pose with hiros calibrate people"
    return "its joints are off one by one: it is noisier than assumed"
