"""A suite: logs with what is expected of them, in one TOML file.

::

    [defaults]
    preset = "default"

    [[log]]
    name = "two people crossing"
    input = "two_people_crossing.mcap"
    golden = "golden/two_people_crossing.mcap"   # or .json: metrics alone
    require = ["mpjpe <= 25 mm", "id_switches = 0"]

Paths are relative to the suite's file.
"""

from __future__ import annotations

import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from hiros_mcap.config import Config, load_config
from hiros_mcap.errors import ConfigError, HirosError
from hiros_mcap.evaluate import load_truth
from hiros_mcap.evaluate.logs import output_channels
from hiros_mcap.outputs import check_outputs
from hiros_mcap.params import Params, explain
from hiros_mcap.regression.differences import Divergence, compare_logs
from hiros_mcap.regression.golden import write_golden
from hiros_mcap.regression.metrics import (
    Threshold,
    load_metrics,
    metrics_of,
    save_metrics,
    worse,
)
from hiros_mcap.regression.tolerances import Tolerances, beside, validated
from hiros_mcap.running.pipeline import ProcessOptions, Progress, Silent, process
from hiros_mcap.workers import run_tasks

Status = Literal["equal", "different", "error"]


class Case(Params):
    """One log of a suite."""

    name: str = Field("", description="Of the case; the input's name by default.")
    input: str = Field(description="The recording.")
    golden: str = Field(
        "", description="Compact log (.mcap) or metrics (.json) to compare with; made by --bless."
    )
    channels: tuple[str, ...] = Field(
        (), description="Globs of the channels in the golden log. Default: the last stage's."
    )
    require: tuple[str, ...] = Field((), description='Thresholds: "mpjpe <= 25 mm".')
    truth: str = Field("", description="File with the truth. Default: the log's own.")
    preset: str = "default"
    config: str = Field("", description="TOML file with parameters.")
    set: tuple[str, ...] = Field((), description="Parameters: stage.param=value.")
    system: str = "hiros"
    stages: str = Field("", description="Chain of the system's stages. Default: all.")
    tolerances: dict[str, float] = Field(
        {}, description="Instead of those in GOLDEN.tolerances.toml."
    )

    @field_validator("require")
    @classmethod
    def _thresholds(cls, texts: tuple[str, ...]) -> tuple[str, ...]:
        for text in texts:
            try:
                Threshold.parse(text)
            except ConfigError as error:
                raise ValueError(str(error)) from None
        return texts

    @model_validator(mode="after")
    def _expects_something(self) -> Case:
        if not self.golden and not self.require:
            raise ValueError("expects nothing: give it a golden file or thresholds (require)")
        if self.golden and Path(self.golden).suffix not in (".mcap", ".json"):
            raise ValueError(f"golden {self.golden!r} is neither .mcap nor .json")
        return self

    @property
    def title(self) -> str:
        """Name that reports use."""
        return self.name or Path(self.input).stem


@dataclass(frozen=True, slots=True)
class Suite:
    """All cases of a file."""

    path: Path
    cases: tuple[Case, ...]

    @property
    def files(self) -> list[Path]:
        """Everything that a run of the suite reads or compares with."""
        named = (
            name
            for case in self.cases
            for name in (case.input, case.golden, case.truth, case.config)
            if name
        )
        return [self.path, *(self.path.parent / name for name in named)]


@dataclass(frozen=True, slots=True)
class CaseResult:
    """What became of a case."""

    name: str
    status: Status
    faults: tuple[str, ...] = ()
    """What differs, one line each; for an error, what went wrong."""
    first: tuple[tuple[str, Divergence], ...] = ()
    """Channel and first diverging frame."""
    notes: tuple[str, ...] = ()
    """Improvements, and what --bless accepted."""
    metrics: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0


def load_suite(path: Path) -> Suite:
    """Read a suite.

    Raises
    ------
    ConfigError
        Naming the file and the case that is at fault.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    defaults, rows = table.pop("defaults", {}), table.pop("log", [])
    if table or not isinstance(defaults, dict) or not isinstance(rows, list) or not rows:
        raise ConfigError(f"{path}: expects [[log]] tables, and [defaults] if you like")
    cases = tuple(_case(path, k, defaults, row) for k, row in enumerate(rows, start=1))
    titles = [case.title for case in cases]
    for title in titles:
        if titles.count(title) > 1:
            raise ConfigError(f"{path}: two cases are called {title!r}")
    return Suite(path, cases)


def _case(path: Path, number: int, defaults: dict[str, Any], row: Any) -> Case:
    if not isinstance(row, dict):
        raise ConfigError(f"{path}: log {number} is not a table")
    try:
        case = Case.model_validate({**defaults, **row})
    except ValidationError as error:
        where, message = explain(error)
        label = row.get("name") or row.get("input") or number
        key = f"{'.'.join(where)}: " if where else ""
        raise ConfigError(f"{path}: log {label}: {key}{message}") from None
    if not (path.parent / case.input).is_file():
        raise ConfigError(f"{path}: log {case.title}: no file {case.input}")
    validated(case.tolerances, f"{path}: log {case.title}: tolerances")
    return case


def run_suite(
    suite: Suite,
    *,
    bless: bool = False,
    only: Sequence[str] = (),
    jobs: int = 0,
    keep: Path | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> list[CaseResult]:
    """Process and check every log, several at once; results in the order of the suite.

    Parameters
    ----------
    bless : replace the golden files by what came out now; notes say what changed.
    only : names of the cases to run. jobs : processes at once; 0 = one per core.
    keep : folder to leave the outputs in, one ``NAME.mcap`` each.
    force : replace files in there that hiros did not write.

    Raises
    ------
    ConfigError
        A name in ``only`` does not exist.
    LogError
        A file in ``keep`` must not be replaced.
    """
    titles = [case.title for case in suite.cases]
    if unknown := [name for name in only if name not in titles]:
        raise ConfigError(f"{suite.path}: no case {unknown[0]!r} (there are: {', '.join(titles)})")
    cases = [case for case in suite.cases if not only or case.title in only]
    if keep is not None:
        check_outputs(((kept_path(keep, case), "log") for case in cases), suite.files, force=force)
    progress, done = progress or Silent(), {}
    tasks = [(suite.path.parent, case, bless, keep) for case in cases]
    for _, result in run_tasks(run_case, tasks, jobs):
        done[result.name] = result
        progress.update(len(done), len(cases))
    return [done[case.title] for case in cases]


def run_case(folder: Path, case: Case, bless: bool = False, keep: Path | None = None) -> CaseResult:
    """Process one log and check it; whatever is wrong with it becomes the result."""
    start = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as temporary:
            out = kept_path(keep or Path(temporary), case)
            config = load_config(
                folder / case.config if case.config else None,
                case.set,
                case.preset,
                case.system,
            )
            _process(folder / case.input, out, case, config)
            result = _check(folder, case, out, bless=bless)
    except (HirosError, OSError) as error:
        result = CaseResult(case.title, "error", (str(error),))
    values = {name: getattr(result, name) for name in CaseResult.__slots__}
    return CaseResult(**{**values, "seconds": time.perf_counter() - start})


def kept_path(folder: Path, case: Case) -> Path:
    """Return where the output of a case is left."""
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in case.title)
    return folder / f"{name}.mcap"


def _process(source: Path, out: Path, case: Case, config: Config) -> None:
    options = ProcessOptions(system=case.system, stages=case.stages, keep=("/truth/*",))
    # Whether ``out`` may be replaced was asked before the first case ran.
    process(source, out, config=config, options=options, force=True)


def check_output(
    output: Path,
    golden: Path,
    tolerances: Tolerances | None = None,
    channels: Sequence[str] = (),
    *,
    bless: bool = False,
) -> CaseResult:
    """Compare one output with its golden file, or make it the golden file.

    Raises
    ------
    HirosError
        The two cannot be compared.
    """
    if golden.suffix not in (".mcap", ".json"):
        raise ConfigError(f"{golden}: a golden file ends in .mcap (a log) or .json (metrics)")
    if not golden.is_file() and not bless:
        raise ConfigError(f"{golden}: no such golden file; --bless makes it")
    topic = output_channels(output)[-1]
    metrics = metrics_of(output, topic)
    return _judge(
        _Subject(output.name, output, topic, metrics), golden, tolerances, channels, bless
    )


@dataclass(frozen=True, slots=True)
class _Subject:
    """An output that is judged."""

    title: str
    path: Path
    topic: str
    metrics: dict[str, float]


def _check(folder: Path, case: Case, out: Path, *, bless: bool) -> CaseResult:
    topic = output_channels(out)[-1]
    truth = load_truth(folder / case.truth) if case.truth else None
    metrics = metrics_of(out, topic, truth)
    unmet = [f for text in case.require if (f := Threshold.parse(text).fault(metrics))]
    if not case.golden:
        return CaseResult(
            case.title, "different" if unmet else "equal", tuple(unmet), metrics=metrics
        )
    tolerances = Tolerances(**case.tolerances) if case.tolerances else None
    subject = _Subject(case.title, out, topic, metrics)
    judged = _judge(subject, folder / case.golden, tolerances, case.channels, bless)
    faults = (*unmet, *judged.faults)
    status: Status = "different" if faults else "equal"
    return CaseResult(case.title, status, faults, judged.first, judged.notes, metrics)


def _judge(
    subject: _Subject,
    golden: Path,
    tolerances: Tolerances | None,
    channels: Sequence[str],
    bless: bool,
) -> CaseResult:
    faults, gains, first = _compare(subject, golden, tolerances)
    if bless:
        notes = _bless(subject, golden, channels, faults + gains)
        return CaseResult(subject.title, "equal", notes=tuple(notes), metrics=subject.metrics)
    notes = [f"better: {gain}" for gain in gains]
    status: Status = "different" if faults else "equal"
    return CaseResult(
        subject.title, status, tuple(faults), tuple(first), tuple(notes), subject.metrics
    )


def _compare(
    subject: _Subject, golden: Path, tolerances: Tolerances | None
) -> tuple[list[str], list[str], list[tuple[str, Divergence]]]:
    """Return what is worse or differs, what is better, and where it begins."""
    tolerances = tolerances or beside(golden)
    if not golden.is_file():
        return [f"there is no golden file {golden.name} yet; --bless makes it"], [], []
    if golden.suffix == ".json":
        _, before = load_metrics(golden)
        faults, gains = worse(subject.metrics, before, tolerances.metrics)
        return faults, gains, []
    comparison = compare_logs(subject.path, golden, tolerances)
    found = comparison.faults(tolerances)
    faults = [f"{channel}: {line}" for channel, lines in found.items() for line in lines]
    equal = [channel.topic for channel in comparison.channels if channel.topic not in found]
    if found and equal:
        faults.insert(
            0, f"first stage that differs: {next(iter(found))}; equal: {', '.join(equal)}"
        )
    first = [
        (channel.topic, channel.first)
        for channel in comparison.channels
        if channel.topic in found and channel.first is not None
    ]
    return faults, [], first


def _bless(
    subject: _Subject, golden: Path, channels: Sequence[str], changes: list[str]
) -> list[str]:
    """Replace the golden file if anything changed; return what was accepted."""
    if not golden.is_file():
        changes = ["a new golden file"]
    elif not changes:
        return ["as before; the golden file stays"]
    golden.parent.mkdir(parents=True, exist_ok=True)
    if golden.suffix == ".json":
        save_metrics(golden, subject.topic, subject.metrics)
    else:
        write_golden(subject.path, golden, channels)
    return [f"accepted: {change}" for change in changes]
