"""The ablations of Lee et al. (2022, section 3) against a truth.

    python benchmarks/papers/lee_2022.py [variants|radius|cameras|choices|gestures] [LOG ...]

variants : A1 to A5 (section 3.1). radius : four radii of A5 (3.2). cameras : every subset of the
cameras (3.3). choices : what the paper leaves open, and other ways to do it. gestures : Tables A1
to A4, the six gestures in four directions, always simulated. Without LOG, simulated logs of people
who walk and of slow gestures. Mean error and standard deviation, mm, by parts of the body; the
paper's numbers stand in [ ]. They come from other data: Azure Kinects, the camera in front as
reference.

The simulated detector is the ideal one, which papers assume: each joint errs by itself.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

from lee_2022_gestures import (
    appendix_tables,
    check_gestures,
    gesture_errors,
    gesture_scenes,
    gesture_table,
)
from paper_report import Claim, PaperReport, Rows, Table, arguments, check_order, mean
from published import LEE, LEE_CAMERAS, LEE_RADII, Pair, lee_appendix, lee_mean

from hiros_mcap.evaluate import ErrorStats
from hiros_mcap.evaluate.comparison import (
    Entry,
    Outcome,
    Task,
    by_number_of_cameras,
    camera_subsets,
    comparison,
)
from hiros_mcap.evaluate.statistics import PARTS, part_of
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_mcap.wording import number

ENTRIES = {
    "variants": ("lee-a1", "lee-a2", "lee-a3", "lee-a4", "lee"),
    "radius": tuple(f"lee,cluster.radius={radius:g}" for radius in LEE_RADII),
    "cameras": ("lee",),
    "choices": (
        "hiros",
        *("lee-a1", "lee-a2", "lee-a3", "lee-a4", "lee"),
        *(
            f"{name},cluster.radius={radius:g}"
            for name in ("lee-a4", "lee")
            for radius in LEE_RADII
        ),
        "lee-a2,cluster.rearrange=both",
        "lee-a4,cluster.rearrange=both",
        "lee-a4,cluster.compensate_motion=false",
        "lee,predict.output=corrected",
        "lee,predict.model=constant_position,predict.output=corrected",
        "lee,predict.model=constant_acceleration",
        "lee,predict.model=constant_acceleration,predict.output=corrected",
    ),
}
SCENES: tuple[dict[str, object], ...] = (
    *({"people": people, "seed": people} for people in (1, 2, 4)),
    *(
        {"people": 1, "seed": 3, "cameras": 4, "action": action}
        for action in ("squat", "bend", "cross_arms")
    ),
)


def part_table(title: str, outcomes: Sequence[Outcome]) -> Table:
    """Error (SD) by part, mean over the logs, a row per system; the paper's in [ ]."""
    rows: Rows = []
    for name in dict.fromkeys(o.name for o in outcomes):
        scores = [o.scores for o in outcomes if o.name == name and o.scores is not None]
        published = _published(name)
        cells = [
            _cell(_mean_pair([s.parts[part] for s in scores if part in s.parts]), paper)
            for part, paper in zip(PARTS, published, strict=True)
        ]
        whole = (mean(s.mean for s in scores), mean(s.deviation for s in scores))
        motion = (mean(s.jitter for s in scores), mean(s.lag for s in scores))
        rows.append((name, _cell(whole), *cells, *(number(value, 1) for value in motion)))
    header = ("Variant", "All", *(part.capitalize() for part in PARTS), "Jitter", "Lag, ms")
    return Table(title, header, rows)


def _published(name: str) -> tuple[Pair | None, ...]:
    """The paper's errors of a system, by part; section 3.2 gives the radii of A5."""
    if name in LEE:
        return LEE[name]
    for radius, pairs in LEE_RADII.items():
        if name == f"lee,cluster.radius={radius:g}":
            return pairs
        if name == f"lee-a4,cluster.radius={radius:g}":
            column, joints = f"A4_{100 * radius:.0f}", {joint for _, joint in lee_appendix()}
            groups = [tuple(joint for joint in joints if part_of(joint) == p) for p in PARTS]
            return tuple(lee_mean(column, group) for group in groups)
    return (None,) * len(PARTS)


def joint_table(outcomes: Sequence[Outcome]) -> Table:
    """Error (SD) of every joint, a column per system: the layout of Tables A1 to A6."""
    names = list(dict.fromkeys(o.name for o in outcomes))
    scores = {n: [o.scores for o in outcomes if o.name == n and o.scores] for n in names}
    joints = dict.fromkeys(joint for group in scores.values() for s in group for joint in s.joints)
    rows: Rows = [
        (
            joint,
            *(
                _cell(_mean_pair([s.joints[joint] for s in scores[n] if joint in s.joints]))
                for n in names
            ),
        )
        for joint in joints
    ]
    return Table("By joint, as Tables A1 to A6, mm", ("Joint", *names), rows)


def camera_table(errors: Mapping[str, Mapping[int, Pair]]) -> Table:
    """Error (SD) by number of cameras, mean over all subsets; the paper's below."""
    sizes = sorted({size for row in errors.values() for size in row})
    rows: Rows = [
        (name, *(_cell(row[size]) if size in row else "-" for size in sizes))
        for name, row in errors.items()
    ]
    for k, part in enumerate(PARTS):
        cells = (_cell(LEE_CAMERAS[n][k]) if n in LEE_CAMERAS else "-" for n in sizes)
        rows.append((f"paper: {part}", *cells))
    return Table("By number of cameras, mm", ("System", *map(str, sizes)), rows)


def _mean_pair(errors: Sequence[ErrorStats]) -> Pair:
    return mean(e.mean for e in errors), mean(e.deviation for e in errors)


def _cell(ours: Pair, paper: Pair | None = None) -> str:
    text = f"{number(ours[0], 1)} ({number(ours[1], 1)})"
    return text if paper is None else f"{text} [{paper[0]:.1f} ({paper[1]:.1f})]"


def check_claims(outcomes: Sequence[Outcome]) -> Iterator[Claim]:
    """Check the order of the variants and the best radius."""
    by_name = {
        name: [o.scores for o in outcomes if o.name == name and o.scores is not None]
        for name in dict.fromkeys(o.name for o in outcomes)
    }
    upper = {
        name: mean(s.parts["upper limbs"].mean for s in scores if "upper limbs" in s.parts)
        for name, scores in by_name.items()
    }
    order = ("lee", "lee-a4", "lee-a3", "lee-a1")
    yield from check_order("upper limbs: A5 <= A4 <= A3 <= A1", upper, order)
    radii = {
        radius: mean(s.mean for s in by_name[name])
        for radius in LEE_RADII
        if (name := f"lee,cluster.radius={radius:g}") in by_name
    }
    if len(radii) > 2:
        yield Claim(
            "radii: the least error is at 10 cm (+-5 cm)",
            min(radii, key=lambda radius: radii[radius]) <= 0.15,
            ", ".join(f"{radius:g} m: {error:.1f} mm" for radius, error in radii.items()),
        )


def check_cameras(errors: Mapping[str, Mapping[int, Pair]]) -> Iterator[Claim]:
    """Check that the error falls with every camera (section 3.3; Malaguti et al. 2019, Fig. 4)."""
    for name, row in errors.items():
        sizes = sorted(row)
        values = [row[n][0] for n in sizes]
        if len(sizes) > 1:
            yield Claim(
                f"{name}: the error falls with every camera added",
                all(more < fewer for fewer, more in pairwise(values)),
                ", ".join(f"{n}: {e:.1f} mm" for n, e in zip(sizes, values, strict=True)),
            )


def report(study: str, logs: Sequence[Path], jobs: int) -> PaperReport:
    """Run a study of :data:`ENTRIES` on logs."""
    tasks = [Task(log, Entry.parse(text)) for log in logs for text in ENTRIES[study]]
    note = "the paper's numbers come from other data: Azure Kinects, the camera in front as truth"
    if study == "cameras":
        tasks = [subset for task in tasks for subset in camera_subsets(task)]
        errors = by_number_of_cameras(comparison(tasks, jobs=jobs))
        table = camera_table(errors)
        return PaperReport("Lee et al. 2022: cameras", note, [table], list(check_cameras(errors)))
    outcomes = comparison(tasks, jobs=jobs)
    if study == "choices":
        tables = [
            part_table(name, [o for o in outcomes if o.log == name])
            for name in dict.fromkeys(o.log for o in outcomes)
        ]
    else:
        tables = [part_table("By part, mm", outcomes), joint_table(outcomes)]
    return PaperReport(f"Lee et al. 2022: {study}", note, tables, list(check_claims(outcomes)))


def gesture_report(logs: Mapping[Path, str], jobs: int) -> PaperReport:
    """Run the six gestures; ``logs`` gives the gesture of each log."""
    errors = gesture_errors(logs, jobs)
    note = (
        "truth: the simulated people. Paper: the camera in front; its A3 is the same for all radii"
    )
    tables = [gesture_table(errors), *appendix_tables(errors)]
    return PaperReport("Lee et al. 2022: gestures", note, tables, list(check_gestures(errors)))


def simulated(
    folder: Path, scenes: Iterable[Mapping[str, object]], seconds: float
) -> dict[Path, str]:
    """Write a log for each scene; return the action of each log."""
    logs = {}
    for scene in scenes:
        named = (f"{key} {value}" for key, value in scene.items() if key != "rig")
        log = folder / (" ".join(named) + ".mcap")
        write_log(log, SimulateParams.model_validate({"seconds": seconds, **scene}))
        logs[log] = str(scene.get("action", "walk"))
    return logs


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("study", nargs="?", choices=[*ENTRIES, "gestures"], default="variants")
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of simulated logs")
    given = parser.parse_args()
    if given.study == "gestures" and given.logs:
        parser.error("gestures takes no LOG: it simulates each gesture in four directions")
    with tempfile.TemporaryDirectory() as folder:
        if given.study == "gestures":
            logs = simulated(Path(folder), gesture_scenes(), given.seconds)
            gesture_report(logs, given.jobs).present(given.html)
            return
        found = given.logs or list(simulated(Path(folder), SCENES, given.seconds))
        report(given.study, found, given.jobs).present(given.html)


if __name__ == "__main__":
    main()
