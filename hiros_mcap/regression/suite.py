"""A suite: logs with what is expected of them, in one TOML file.

::

    [defaults]
    preset = "default"

    [[log]]
    name = "two people crossing"
    input = "two_people_crossing.mcap"
    golden = "golden/two_people_crossing.mcap"
    require = ["mpjpe <= 25 mm", "id_switches = 0"]

Paths are relative to the suite's file. Golden files are small, because they are kept under version
control.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from hiros_mcap.config import Settings
from hiros_mcap.defaults import default_system
from hiros_mcap.errors import ConfigError, HirosError
from hiros_mcap.evaluate import load_truth
from hiros_mcap.evaluate.logs import output_channels, read_channel
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    PROVENANCE,
    add_skeleton_channel,
)
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_reader
from hiros_mcap.outputs import check_outputs
from hiros_mcap.outside import read_toml
from hiros_mcap.params import Params
from hiros_mcap.progress import Bar, Progress
from hiros_mcap.regression.differences import (
    Difference,
    Divergence,
    Provenance,
    changes,
    compare_logs,
)
from hiros_mcap.regression.metrics import Threshold, metrics_of
from hiros_mcap.regression.quantities import Tolerances, beside, validated
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.skeletons import Floats, Frame
from hiros_mcap.workers import run_tasks

Status = Literal["equal", "different", "error"]
GOLDEN_SUFFIX = ".mcap"


class Case(Params):
    """One log of a suite."""

    name: str = Field("", description="Of the case. Default: the input's name.")
    input: str = Field(description="The recording.")
    golden: str = Field("", description="Compact log (.mcap) to compare with; made by --bless.")
    channels: tuple[str, ...] = Field(
        (), description="Globs of the channels in the golden log. Default: the last stage's."
    )
    require: tuple[str, ...] = Field((), description='Thresholds: "mpjpe <= 25 mm".')
    truth: str = Field("", description="File with the truth. Default: the log's own.")
    preset: str = "default"
    config: str = Field(
        "", description="TOML file with parameters. Default: hiros.toml of the input."
    )
    set: tuple[str, ...] = Field((), description="Parameters: stage.param=value.")
    system: str = Field("", description="Default: fuse; with a preset hiros.")
    stages: str = Field("", description="Chain of the system's stages. Default: all.")
    tolerances: Tolerances | None = Field(
        None, description="Instead of those in GOLDEN.tolerances.toml."
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
        if "\0" in self.input + self.golden + self.truth + self.config:
            raise ValueError("names a file with a null character, which no file can have")
        if not self.golden and not self.require:
            raise ValueError("expects nothing: give it a golden file or thresholds (require)")
        if self.golden and Path(self.golden).suffix != GOLDEN_SUFFIX:
            raise ValueError(f"golden {self.golden!r} is no .mcap file")
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
    """Whether a case gives what is expected of it."""

    name: str
    status: Status
    error: str = ""  # why it cannot be compared
    differences: tuple[Difference, ...] = ()  # changes of parameters, version and input come first
    first: tuple[tuple[str, Divergence], ...] = ()  # channel and first diverging frame
    notes: tuple[str, ...] = ()  # which stages are equal, improvements, and what --bless accepted
    metrics: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0


def load_suite(path: Path) -> Suite:
    """Read a suite.

    Raises ConfigError naming the file and the case that is at fault.
    """
    table = read_toml(path)
    rows: Any = table.pop("log", [])
    defaults: Any = table.pop("defaults", {})
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
    label = row.get("name") or row.get("input") or number
    return validated(Case, {**defaults, **row}, f"{path}: log {label}")


def run_suite(
    suite: Suite,
    *,
    bless: bool = False,
    only: Sequence[str] = (),
    jobs: int = 0,
    keep: Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> list[CaseResult]:
    """Process and check every log, several at once; results in the order of the suite.

    Parameters
    ----------
    bless : replace the golden files by what came out now; notes say what changed.
    only : names of the cases to run; empty = all. jobs : processes at once; 0 = one per core.
    keep : folder to leave the outputs in, one ``NAME.mcap`` each.
    force : replace files in there that hiros did not write.

    Raises ConfigError if ``only`` names a case that does not exist; LogError if a file in ``keep``
    must not be replaced.
    """
    titles = [case.title for case in suite.cases]
    if unknown := [name for name in only if name not in titles]:
        raise ConfigError(f"{suite.path}: no case {unknown[0]!r} (there are: {', '.join(titles)})")
    cases = [case for case in suite.cases if not only or case.title in only]
    if keep is not None:
        check_outputs(((kept_path(keep, case), "log") for case in cases), suite.files, force=force)
    progress, done = progress or Bar(), {}
    tasks = [(suite.path.parent, case, bless, keep) for case in cases]
    for k, result in run_tasks(run_case, tasks, jobs):
        done[k] = result
        progress.update(len(done), len(cases))
    return [done[k] for k in range(len(cases))]


LOG_TIME = "output.log_time"
LOG_TIMES = f"{LOG_TIME}=causal"
"""Assignment that the cases of a suite are run with, unless they set it themselves."""


def run_case(folder: Path, case: Case, bless: bool = False, keep: Path | None = None) -> CaseResult:
    """Process one log and check it; whatever is wrong with it becomes the result."""
    start = time.perf_counter()
    try:
        if not (folder / case.input).exists():
            raise ConfigError(f"{folder / case.input}: there is no such input")
        with tempfile.TemporaryDirectory() as temporary:
            out = kept_path(keep or Path(temporary), case)
            file = folder / case.config if case.config else None
            system = case.system or default_system(case.preset)
            # A golden log also guards how late results are.
            assignments = (LOG_TIMES, *case.set)
            settings = Settings(system, case.preset, file, assignments).of(folder / case.input)
            options = ProcessOptions(system=system, stages=case.stages, keep=("/truth/*",))
            # Whether ``out`` may be replaced was asked before the first case ran.
            process(folder / case.input, out, config=settings.load(), options=options, force=True)
            result = _check_case(folder, case, out, bless=bless)
    except (HirosError, OSError) as error:
        result = CaseResult(case.title, "error", str(error))
    return replace(result, seconds=time.perf_counter() - start)


def kept_path(folder: Path, case: Case) -> Path:
    """Return where the output of a case is left."""
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in case.title)
    return folder / f"{name}.mcap"


def _check_case(folder: Path, case: Case, out: Path, *, bless: bool) -> CaseResult:
    topic = output_channels(out)[-1]
    truth = load_truth(folder / case.truth) if case.truth else None
    metrics = metrics_of(out, topic, truth)
    result = CaseResult(case.title, "equal", metrics=metrics)
    if case.golden:
        golden = Golden(
            folder / case.golden,
            case.tolerances,
            case.channels,
        )
        result = golden.check(result, out, bless=bless)
    required = (Threshold.parse(text) for text in case.require)
    unmet = tuple(d for threshold in required if (d := threshold.difference(metrics)))
    if not unmet:
        return result
    return replace(result, status="different", differences=(*result.differences, *unmet))


def check_output(output: Path, golden: Golden, *, bless: bool = False) -> CaseResult:
    """Compare one output with its golden file, or make it the golden file.

    Raises HirosError if the two cannot be compared.
    """
    if golden.path.suffix != GOLDEN_SUFFIX:
        raise ConfigError(f"{golden.path}: a golden file ends in {GOLDEN_SUFFIX}")
    if not golden.path.is_file() and not bless:
        raise ConfigError(f"{golden.path}: no such golden file; --bless makes it")
    topic = output_channels(output)[-1]
    result = CaseResult(output.name, "equal", metrics=metrics_of(output, topic))
    return golden.check(result, output, bless=bless)


@dataclass(frozen=True, slots=True)
class Golden:
    """The golden file that an output is compared with."""

    path: Path
    tolerances: Tolerances | None = None  # none = those beside the golden file, else the defaults
    channels: Sequence[str] = ()
    """Globs of the channels that a new golden log keeps; empty = the last stage's."""

    def check(self, result: CaseResult, output: Path, *, bless: bool) -> CaseResult:
        """Return the result with what differs, or make the output the golden file."""
        if not self.path.is_file():
            if not bless:
                fault = f"{self.path}: there is no golden file yet; --bless makes it"
                return replace(result, status="error", error=fault)
            self._replace(output)
            return replace(result, notes=("accepted: a new golden file",))
        provenance, compared = self._compare(result, output)
        changed = changes(Provenance.of_log(output), provenance)
        if bless:
            new = compared.differences
            if not (new or changed or not provenance):
                return replace(result, notes=("unchanged; the golden file is kept",))
            self._replace(output)
            accepted = [f"accepted: {change}" for change in (*changed, *new)]
            return replace(result, notes=tuple(accepted or ["accepted: how the result was made"]))
        if not compared.differences:
            return compared
        differences = (*changed, *compared.differences)
        return replace(compared, status="different", differences=differences)

    def _compare(self, result: CaseResult, output: Path) -> tuple[Provenance, CaseResult]:
        """Return how the golden file was made, and what differs."""
        tolerances = self.tolerances or beside(self.path)
        provenance, notes = Provenance.of_log(self.path), []
        kinds = [p.parameters.get(LOG_TIME) for p in (provenance, Provenance.of_log(output))]
        one_kind = kinds[0] == kinds[1] or None in kinds
        if not one_kind:
            notes.append(
                f"log times are not compared: of the golden log they are {kinds[0]}, of the result "
                f"{kinds[1]} ({LOG_TIME})"
            )
        comparison = compare_logs(output, self.path, tolerances, log_times=one_kind)
        by_channel = comparison.differences(tolerances)
        equal = [c.topic for c in comparison.channels if c.topic not in by_channel]
        if by_channel and equal:
            stage = next(iter(by_channel))
            notes.append(f"first channel that differs: {stage}; equal: {', '.join(equal)}")
        if by_channel and not provenance:
            notes.append(
                "the golden file does not say how it was made, since an older hiros wrote it; "
                "--bless adds this"
            )
        differ = [c for c in comparison.channels if c.topic in by_channel]
        first = tuple((c.topic, c.first) for c in differ if c.first is not None)
        lines = tuple(line for lines in by_channel.values() for line in lines)
        compared = replace(result, differences=lines, first=first, notes=tuple(notes))
        return provenance, compared

    def _replace(self, output: Path) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_golden(output, self.path, self.channels)


_GRID = np.repeat([2.0**-23, 2.0**-16, 2.0**-10, 2.0**-23], [7, 6, 6, 3])
"""Of the columns of a Box: poses, velocities, accelerations, sizes. The numbers of a golden log are
multiples of these, so that they compress: at most a sixth of the default tolerances, such as 0.12
micrometres."""


def write_golden(
    output: str | os.PathLike[str], golden: str | os.PathLike[str], topics: Sequence[str] = ()
) -> None:
    """Write a compact copy of channels of an output.

    Kept are all numbers of the skeletons, rounded, and how the output came about: version,
    configuration, hash of the input.

    Parameters
    ----------
    output : what ``hiros process`` wrote. golden : the file to write.
    topics : globs of output channels; empty = the last stage's.
    """
    chosen = output_channels(output, topics) if topics else output_channels(output)[-1:]
    channels = {topic: read_channel(output, topic) for topic in chosen}
    with McapWriter(Path(golden), inputs=[output]) as writer:
        for topic, (frames, model, _) in channels.items():
            encoder = Encoder(model)
            channel = add_skeleton_channel(writer, topic)
            for frame in frames:
                writer.write(channel, frame.log_time, encoder.encode(compact(frame)))
        with open_reader(output) as reader:
            if (content := reader.attachment(CONFIG_ATTACHMENT)) is not None:
                writer.add_attachment(CONFIG_ATTACHMENT, content, "application/toml")
            for name, values in reader.contents.metadata:
                if name == PROVENANCE:
                    writer.add_metadata(name, values)
        writer.commit()


def compact(frame: Frame) -> Frame:
    """Return a frame with rounded numbers."""
    names = "confidences", "marker_confidences", "link_confidences"
    rounded = {name: _rounded(getattr(frame, name), _GRID[0]) for name in names}
    for name in ("markers", "links", "boxes"):
        states = getattr(frame, name)
        rounded[name] = _rounded(states, _GRID[: states.shape[-1]])
    return frame.replace(**rounded)


def _rounded(numbers: Floats, grid: Floats) -> Floats:
    return np.asarray(np.rint(numbers / grid) * grid)
