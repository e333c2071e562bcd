"""Errors of detectors: real recordings beside logs of a simulated detector.

    python benchmarks/detector.py LOG...                  beside 12 simulated logs
    python benchmarks/detector.py LOG... --seeds 24 --first 900 --detector ideal

LOGs are of two cameras, best of two people who stand, face the cameras and now and then pass each
other: so does the simulated scene (``scenes.realistic``). All are measured alike: the views of the
tracker (in the fixed frame, with ids) against the other camera's view at the time, and against the
fused result. Exchanged sides are turned back first. "Clear" are views of people of whom others
cover less than 2 %, "behind" those of whom others cover more than 25 %; bodies are capsules.

Prints Markdown: quantiles, shares or rates of all logs together, and the middle half of the real
logs by themselves. A row is marked where these agree within a factor of 2, and a simulated number
is off by a factor of more than 1.5. "nan" are views of which there are none.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scenes import DETECTOR, realistic

from hiros_mcap.body.segments import HEAD, NECK, PELVIS, finder
from hiros_mcap.config import load_config
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.running.preparation import camera_positions
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.recording import Recording
from hiros_mcap.simulate.chance import runs
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, Frame, SkeletonModel, Stamps

CLEAR, BEHIND = 0.02, 0.25
WRONG_M, SLIP_M = 0.25, 0.2
STANDING, MOVING = 0.05, 0.3
"""m/s of the middle of a body."""
GAP_S = 0.12
"""Views are not compared over longer gaps, and longer ones are dropouts."""
EXCHANGED = 0.6
"""Of the error of a view, what is left where its sides are turned back."""
PARTS = ("shoulder", "elbow", "wrist", "hand", "hip", "knee", "ankle", "foot")
JOINTS = ["pelvis", "neck", "head", *(f"{part} {side}" for side in "LR" for part in PARTS)]
MIRROR = [JOINTS.index(name.translate(str.maketrans("LR", "RL"))) for name in JOINTS]
CAPSULES = [("pelvis", "neck", 0.15), ("neck", "head", 0.08)] + [
    (f"{a} {side}", f"{b} {side}", radius)
    for side in "LR"
    for a, b, radius in (
        *(("shoulder", "elbow", 0.05), ("elbow", "wrist", 0.04)),
        *(("hip", "knee", 0.08), ("knee", "ankle", 0.055)),
    )
]
LENGTHS = {
    "thigh": [("hip L", "knee L"), ("hip R", "knee R")],
    "shank": [("knee L", "ankle L"), ("knee R", "ankle R")],
    "upper arm": [("shoulder L", "elbow L"), ("shoulder R", "elbow R")],
    "forearm": [("elbow L", "wrist L"), ("elbow R", "wrist R")],
    "trunk": [("pelvis", "neck")],
    "shoulders": [("shoulder L", "shoulder R")],
    "hips": [("hip L", "hip R")],
}
TRUNK = ["pelvis", "neck", "shoulder L", "shoulder R", "hip L", "hip R"]
Samples = Mapping[str, list[Floats]]
"""Measured quantity -> its parts."""


class Row(NamedTuple):
    """A row of the table: quantiles of what was measured, or its mean if there are none."""

    text: str
    key: str
    scale: float = 1.0
    quantiles: tuple[float, ...] = (0.5, 0.95, 0.99)
    digits: int = 0


def rows() -> Iterator[Row]:
    """All rows, in order."""
    mean: tuple[float, ...] = ()
    yield Row("minutes of views", "minutes", 1.0, mean, 1)
    for where in ("front", "side", "back", "behind"):
        yield Row(f"views: {where}, %", where, 100.0, mean, 1)
    for where in ("front", "side", "back"):
        yield Row(f"exchanged sides, {where}, %", f"exchanged {where}", 100.0, mean, 1)
    yield Row("exchanges: 50, 90 %, s", "exchange s", 1.0, (0.5, 0.9), 2)
    yield Row("dropouts per minute", "dropout", 60.0, mean, 1)
    yield Row("dropouts: 50, 90 %, s", "dropout s", 1.0, (0.5, 0.9), 2)
    yield Row("detections of nobody, %", "nobody", 100.0, mean, 2)
    for low, high in ((0.1, 0.25), (0.25, 0.45), (0.45, 0.7)):
        yield Row(f"reported, covered by {low:g} to {high:g}, %", f"reported {low}", 100.0, mean)
    for where in ("clear", "behind"):
        for bone in LENGTHS:
            yield Row(f"{where}: length of {bone} off, %", f"{where} length {bone}", 100.0)
        yield Row(f"{where}: lengths of a body off, rms, %", f"{where} body", 100.0)
        yield Row(f"{where}: shift between cameras, mm", f"{where} shift", 1000.0)
        for part in ("trunk", "head", "elbow", "hand", "knee", "foot"):
            yield Row(f"{where}: {part} beside the shift, mm", f"{where} {part}", 1000.0)
        for part in ("trunk", "hand", "foot"):
            text = f"{where}: second difference, {part}, mm"
            yield Row(text, f"{where} {part} step", 1000.0)
    for where in ("front", "side", "back"):
        yield Row(f"{where}: hand beside the shift, mm", f"{where} hand", 1000.0)
    for where in ("front", "side", "back"):
        text = f"{where}, moving: wrists off by > .2 m, %"
        yield Row(text, f"{where} slips", 100.0, mean, 1)
    for how in ("standing", "moving"):
        yield Row(f"{how}: second difference, hand, mm", f"{how} step", 1000.0)
    for what in ("upper arm", "forearm", "thigh", "shank", "elbow", "wrist", "knee", "ankle"):
        yield Row(f"{what}: correlation after a frame, 1 s", f"{what} lag", 1.0, (), 2)
    for pair in ("thigh, shank", "elbow, wrist", "wrist, hand", "knee, ankle", "ankle, foot"):
        yield Row(f"correlation of {pair}", f"{pair} r", 1.0, (0.5,), 2)
    yield Row("a limb off by > .25 m, per minute", "wrong", 60.0, mean, 1)
    yield Row("such a time: 50, 90 %, s", "wrong s", 1.0, (0.5, 0.9), 2)
    yield Row("it begins at once, %", "wrong at once", 100.0, mean)
    yield Row("joints off the fused result, mm", "off", 1000.0)


@dataclass(frozen=True)
class Track:
    """A camera's views of a person: V in the order of time, J joints."""

    stamps: Stamps
    poses: Floats
    """(V, J, 3) m, with right sides."""
    fused: Floats
    """(V, J, 3) the result at the time; NaN = none."""
    other: Floats
    """(V, J, 3) another camera's view of the person; NaN = none."""
    exchanged: Flags
    covered: Floats
    """(V,) share of the body that others cover."""
    facing: Stamps
    """(V,) 0 from the front, 1 from the side, 2 from behind."""


def joints_of(model: SkeletonModel, positions: Floats) -> Floats:
    """(V, J, 3) of markers (V, M, 3)."""
    at = finder(model, positions)
    names = {"pelvis": PELVIS, "neck": NECK, "head": HEAD, "foot": ("foot", "toe", "big_toe")}
    columns = []
    for joint in JOINTS:
        part, _, side = joint.partition(" ")
        columns.append(
            at(*names.get(part, (part,)), side={"L": "left", "R": "right", "": ""}[side])
        )
    return np.stack(columns, axis=1)


def size(vectors: Floats) -> Floats:
    return np.linalg.norm(vectors, axis=-1)


def covered_by(body: Floats, other: Floats, camera: Floats) -> Floats:
    """(V,) share of the joints of bodies (V, J, 3) that other bodies hide from a camera."""
    rays, hidden = body - camera, np.zeros(body.shape[:2], bool)
    away = size(rays)
    rays = rays / away[..., None]
    for a, b, radius in CAPSULES:
        first, second = other[:, None, JOINTS.index(a)], other[:, None, JOINTS.index(b)]
        for share in np.linspace(0, 1, 6):
            place = first + share * (second - first) - camera
            depth = (place * rays).sum(-1)
            beside = size(place - depth[..., None] * rays)
            hidden |= (beside < radius) & (depth > 0) & (depth < away - 0.15)
    return hidden.mean(axis=1)


def at_times(stamps: Stamps, poses: Floats, asked: Stamps) -> Floats:
    """Poses (V, J, 3) of a person interpolated at times; NaN over gaps."""
    truth = Truth(stamps, poses[:, None], np.zeros((len(stamps), 1, 0, 4)))
    late = np.minimum(np.searchsorted(stamps, asked), len(stamps) - 1)
    gap = stamps[late] - stamps[np.maximum(late - 1, 0)]
    near = truth.positions_of(np.zeros(len(asked), np.int64), asked)
    return np.where((gap < GAP_S * 1e9)[:, None, None], near, np.nan)


def by_person(frames: Sequence[Frame], model: SkeletonModel) -> dict[int, tuple[Stamps, Floats]]:
    """Person -> times and joints of frames of one source."""
    found: dict[int, list[tuple[int, Floats]]] = defaultdict(list)
    for frame in frames:
        for row, person in enumerate(frame.ids.tolist()):
            if person != UNTRACKED:
                found[person].append((frame.stamp, frame.positions[row]))
    made = {}
    for person, views in found.items():
        if len(views) > 30:
            stamps, order = np.unique([stamp for stamp, _ in views], return_index=True)
            made[person] = stamps, joints_of(model, np.stack([views[k][1] for k in order]))
    return made


def measure(log: Path) -> Samples:
    """Measure a log."""
    config, options = load_config(), ProcessOptions()
    recording = Recording.read(log, config, options)
    results = recording.run(config, options)
    model, tracked = recording.model, results["tracked"]
    fused = by_person(results["filtered"], model)
    cameras = camera_positions(recording.prepared.log)
    views = {name: by_person([f for f in tracked if f.source == name], model) for name in cameras}
    samples: dict[str, list[Floats]] = defaultdict(list)
    ids = np.concatenate([frame.ids for frame in tracked])
    samples["nobody"].append((ids == UNTRACKED).astype(float))
    for name, place in cameras.items():
        times = np.array([frame.stamp for frame in tracked if frame.source == name])
        for person in views[name].keys() & fused.keys():
            others = [
                views[other][person] for other in views if other != name and person in views[other]
            ]
            track = track_of(views[name][person], person, others, fused, place)
            add_views(track, samples)
            add_series(track, samples)
            add_losses(track.stamps, times, person, fused, place, samples)
    return samples


def track_of(
    view: tuple[Stamps, Floats], person: int, others: Sequence[tuple[Stamps, Floats]],
    fused: Mapping[int, tuple[Stamps, Floats]], camera: Floats,
) -> Track:  # fmt: skip
    """Gather what a camera shows of a person, and what else is known at these times."""
    stamps, poses = view
    result = at_times(*fused[person], stamps)
    plain, turned = (np.nanmean(size(p - result), axis=1) for p in (poses, poses[:, MIRROR]))
    exchanged = turned < EXCHANGED * plain
    poses = np.where(exchanged[:, None, None], poses[:, MIRROR], poses)
    other = np.full_like(poses, np.nan)
    for their_stamps, their_poses in others:
        theirs = at_times(their_stamps, their_poses, stamps)
        plain, turned = (np.nanmean(size(p - result), axis=1) for p in (theirs, theirs[:, MIRROR]))
        swap = (turned < EXCHANGED * plain)[:, None, None]
        other = np.where(np.isnan(other), np.where(swap, theirs[:, MIRROR], theirs), other)
    return Track(
        stamps, poses, result, other, exchanged, cover(person, stamps, fused, camera),
        facing_of(result, camera),
    )  # fmt: skip


def cover(
    person: int, stamps: Stamps, fused: Mapping[int, tuple[Stamps, Floats]], camera: Floats
) -> Floats:
    """(V,) share of a person's joints that others hide; NaN if it is not known where they are."""
    body = at_times(*fused[person], stamps)
    shares = [covered_by(body, at_times(*fused[o], stamps), camera) for o in fused if o != person]
    return np.where(
        np.isnan(body[:, 0, 0]), np.nan, np.max([np.zeros(len(stamps)), *shares], axis=0)
    )


def facing_of(body: Floats, camera: Floats) -> Stamps:
    """(V,) 0 = from the front, 1 = from the side, 2 = from behind; -1 = not known."""
    across = body[:, JOINTS.index("hip L")] - body[:, JOINTS.index("hip R")]
    ahead = np.stack([across[:, 1], -across[:, 0]], axis=-1)
    ray = (camera - body[:, 0])[:, :2]
    cosine = (ahead * ray).sum(-1) / (size(ahead) * size(ray))
    degrees = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return np.where(np.isnan(degrees), -1, np.digitize(degrees, (45, 135)))


def add_views(track: Track, samples: dict[str, list[Floats]]) -> None:
    """Add what single views show."""
    known = track.facing >= 0
    samples["minutes"].append(np.array([known.sum() / 1800]))
    samples["behind"].append((track.covered[known] > BEHIND).astype(float))
    for k, where in enumerate(("front", "side", "back")):
        samples[where].append((track.facing[known] == k).astype(float))
        samples[f"exchanged {where}"].append(track.exchanged[track.facing == k].astype(float))
    error = track.poses - track.other
    shift = np.nanmedian(error[:, [JOINTS.index(name) for name in TRUNK]], axis=1)
    inner = size(error - shift[:, None])
    steps = np.diff(track.stamps) * 1e-9
    even = np.r_[False, np.maximum(steps[1:], steps[:-1]) < 1.6 * np.median(steps), False]
    second = np.full(inner.shape, np.nan)
    second[1:-1] = size(np.diff(track.poses, 2, axis=0))
    clear = track.covered < CLEAR
    lengths = {bone: deviations(track, ends, clear) for bone, ends in LENGTHS.items()}
    body = np.sqrt(np.mean([(d**2).mean(axis=1) for d in lengths.values()], axis=0))
    for where, these in (("clear", clear), ("behind", track.covered > BEHIND)):
        for bone, off in lengths.items():
            samples[f"{where} length {bone}"].append(np.abs(off[these]).ravel())
        samples[f"{where} body"].append(body[these])
        samples[f"{where} shift"].append(size(shift[these]))
        for part in ("trunk", "head", "elbow", "hand", "knee", "foot"):
            columns = columns_of(part)
            samples[f"{where} {part}"].append(inner[these][:, columns].ravel())
            samples[f"{where} {part} step"].append(second[these & even][:, columns].ravel())
    for k, where in enumerate(("front", "side", "back")):
        samples[f"{where} hand"].append(
            inner[clear & (track.facing == k)][:, columns_of("hand")].ravel()
        )
    off = size(track.poses - track.fused)
    samples["off"].append(off.ravel())
    speed = speed_of(track)
    for k, where in enumerate(("front", "side", "back")):
        wrists = off[clear & (speed > MOVING) & (track.facing == k)][:, columns_of("wrist")]
        samples[f"{where} slips"].append((wrists > SLIP_M).astype(float).ravel())
    for how, these in (("standing", speed < STANDING), ("moving", speed > MOVING)):
        samples[f"{how} step"].append(second[these & clear & even][:, columns_of("hand")].ravel())


def speed_of(track: Track) -> Floats:
    """(V,) m/s of the middle of the fused body over six views; NaN if it is not known."""
    middle, speed = np.nanmean(track.fused, axis=1), np.full(len(track.stamps), np.nan)
    seconds = (track.stamps[6:] - track.stamps[:-6]) * 1e-9
    speed[3:-3] = size(middle[6:] - middle[:-6]) / seconds
    return speed


def columns_of(part: str) -> list[int]:
    """Columns of the joints of a part."""
    names = TRUNK if part == "trunk" else [name for name in JOINTS if name.split()[0] == part]
    return [JOINTS.index(name) for name in names]


def deviations(track: Track, ends: list[tuple[str, str]], clear: Flags) -> Floats:
    """(V, K) relative deviation of lengths from their median in clear views."""
    a, b = ([JOINTS.index(pair[k]) for pair in ends] for k in (0, 1))
    lengths = size(track.poses[:, a] - track.poses[:, b])
    usual = np.nanmedian(lengths[clear] if clear.any() else lengths)
    return lengths / usual - 1


def add_series(track: Track, samples: dict[str, list[Floats]]) -> None:
    """Add how errors go over time, together, and in episodes."""
    if len(track.stamps) < 300:
        return
    off = track.poses - track.fused
    for bone in ("upper arm", "forearm", "thigh", "shank"):
        for series in deviations(track, LENGTHS[bone], track.covered < CLEAR).T:
            samples[f"{bone} lag"].append(memory(track.stamps, series))
    for part in ("elbow", "wrist", "knee", "ankle"):
        for k in columns_of(part):
            samples[f"{part} lag"].append(memory(track.stamps, off[:, k, 0]))
    thigh, shank = (
        deviations(track, LENGTHS[b], track.covered < CLEAR) for b in ("thigh", "shank")
    )
    samples["thigh, shank r"].append(np.array([together(thigh[:, k], shank[:, k]) for k in (0, 1)]))
    for a, b in (("elbow", "wrist"), ("wrist", "hand"), ("knee", "ankle"), ("ankle", "foot")):
        pairs = zip(columns_of(a), columns_of(b), strict=True)
        samples[f"{a}, {b} r"].append(np.array([together(off[:, i], off[:, k]) for i, k in pairs]))
    seconds = np.ptp(track.stamps) * 1e-9
    for part in ("wrist", "ankle"):
        for k in columns_of(part):
            add_episodes(track.stamps, size(off[:, k]), seconds, samples)
    for start, stop in runs(track.exchanged):
        samples["exchange s"].append(duration(track.stamps, start, stop))


def add_episodes(
    stamps: Stamps, off: Floats, seconds: float, samples: dict[str, list[Floats]]
) -> None:
    """Add the times in which a joint is wrong. Their rate is that of all four limbs."""
    found = runs(off > WRONG_M)
    samples["wrong"].append(
        np.repeat([1.0, 0.0], [len(found), round(seconds / 4) - len(found)])
        if seconds / 4 > len(found)
        else np.ones(1)
    )
    for start, stop in found:
        samples["wrong s"].append(duration(stamps, start, stop))
        peak = off[start:stop].max()
        samples["wrong at once"].append(
            np.array([float(off[start] - off[max(start - 1, 0)] > peak / 2)])
        )


def duration(stamps: Stamps, start: int, stop: int) -> Floats:
    """(1,) s of the views from start to stop."""
    return np.array([(stamps[stop - 1] - stamps[start]) * 1e-9 + 1 / 30])


def memory(stamps: Stamps, series: Floats) -> Floats:
    """(1, 2) correlation of a series with itself after a frame and after 1 s; outliers clipped."""
    middle = np.nanmedian(series)
    most = 4 * np.nanmedian(np.abs(series - middle)) + 1e-9
    series = np.clip(series - middle, -most, most)
    found = []
    for lag in (np.median(np.diff(stamps)), 1e9):
        later = np.searchsorted(stamps, stamps + round(lag) - 5_000_000)
        there = later < len(stamps)
        later = np.minimum(later, len(stamps) - 1)
        there &= np.abs(stamps[later] - stamps - lag) < 25_000_000
        found.append(together(series[there], series[later[there]]))
    return np.array([found])


def together(a: Floats, b: Floats) -> float:
    """Correlation of two series about their medians, without outliers over .5."""
    a, b = (x - np.nanmedian(x, axis=0) for x in (a, b))
    known = ~(np.isnan(a) | np.isnan(b)) & (np.abs(a) < 0.5) & (np.abs(b) < 0.5)
    a, b = a[known], b[known]
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum() + 1e-12))


def add_losses(
    stamps: Stamps, times: Stamps, person: int, fused: Mapping[int, tuple[Stamps, Floats]],
    camera: Floats, samples: dict[str, list[Floats]],
) -> None:  # fmt: skip
    """Add whether a camera reports a person where the fused result has one, by its messages."""
    there = ~np.isnan(at_times(*fused[person], times)[:, 0, 0])
    times = times[there]
    if not len(times):
        return
    shown = np.isin(times, stamps)
    covered = cover(person, times, fused, camera)
    for low, high in ((0.1, 0.25), (0.25, 0.45), (0.45, 0.7)):
        these = (covered >= low) & (covered < high)
        samples[f"reported {low}"].append(shown[these].astype(float))
    gaps = [gap for gap in runs(~shown) if duration(times, *gap)[0] > GAP_S]
    seconds = np.ptp(times) * 1e-9
    samples["dropout"].append(
        np.repeat([1.0, 0.0], [len(gaps), max(round(seconds) - len(gaps), 1)])
    )
    samples["dropout s"] += [duration(times, *gap) for gap in gaps]


def numbers(samples: Sequence[Samples], row: Row) -> Floats:
    """Return the numbers of a row, of logs together."""
    parts = [part for each in samples for part in each.get(row.key, [])]
    if not parts:
        return np.full(max(len(row.quantiles), 1), np.nan)
    if row.key == "minutes":
        return np.sum(parts, axis=0)
    if row.key.endswith(" lag"):
        return np.nanmedian(np.concatenate(parts), axis=0)
    values = np.concatenate(parts)
    values = values[~np.isnan(values)]
    if len(values) < 3:
        return np.full(max(len(row.quantiles), 1), np.nan)
    if not row.quantiles:
        return np.array([row.scale * values.mean()])
    return row.scale * np.quantile(values, row.quantiles)


def verdict(logs: Floats, real: Floats, simulated: Floats) -> str:
    """Return by which factors the simulated numbers are off, where the real logs agree."""
    marks = []
    for column, a, b in zip(logs.T, real, simulated, strict=True):
        low, high = (
            np.nanquantile(column, (0.25, 0.75)) if np.isfinite(column).sum() > 1 else (0, 1)
        )
        agree = 0 < low <= high < 2 * low or 0 > high >= low > 2 * high
        factor = b / a if a else np.inf
        off = np.isfinite(b) and not 1 / 1.5 <= factor <= 1.5
        marks.append(f"x {factor:.1f}" if agree and off else "")
    return " / ".join(marks) if any(marks) else ""


def main() -> None:
    parser = argparse.ArgumentParser(parents=[DETECTOR])
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--seeds", type=int, default=12, metavar="N", help="simulated logs")
    parser.add_argument("--first", type=int, default=1, metavar="SEED")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ProcessPoolExecutor(2) as pool:
        seeds = range(given.first, given.first + given.seeds)
        write = partial(simulated, folder=Path(folder), detector=given.detector)
        made = pool.map(write, seeds)
        real, sim = list(pool.map(measure, given.logs)), list(pool.map(measure, made))
    print(f"| | real ({len(real)}) | simulated ({len(sim)}) | middle half of the real logs | |")
    print("|---|---|---|---|---|")
    off = 0
    for row in rows():
        a, b = numbers(real, row), numbers(sim, row)
        by_log = np.array([numbers([each], row) for each in real])
        low, high = np.nanquantile(by_log, (0.25, 0.75), axis=0)
        texts = [" / ".join(f"{x:.{row.digits}f}" for x in cell) for cell in (a, b)]
        spread = " / ".join(
            f"{x:.{row.digits}f}-{y:.{row.digits}f}" for x, y in zip(low, high, strict=True)
        )
        mark = verdict(by_log, a, b) if row.key != "minutes" else ""
        off += bool(mark)
        print(f"| {row.text} | {texts[0]} | {texts[1]} | {spread} | {mark} |")
    print(f"\n{off} rows are off by more than 1.5 where the real logs agree")


def simulated(seed: int, folder: Path, detector: str) -> Path:
    """Write a simulated log and return its path."""
    path = folder / f"{seed}.mcap"
    realistic(path, seed, people=2, cameras=2, detector={"kind": detector})
    return path


if __name__ == "__main__":
    main()
