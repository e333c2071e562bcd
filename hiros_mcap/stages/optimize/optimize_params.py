"""Parameters of the optimizer; the first ones say how limb lengths are found."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from hiros_mcap.params import Metres, Params, Seconds, advanced, fixed


class OptimizeParams(Params):
    """Parameters of calibration, outlier detection and optimization."""

    calibration: Literal["auto", "two-pass", "off"] = Field(
        "auto",
        description="auto: from each person's own frames, during the run. two-pass: from the whole "
        "log, which is read once before (most accurate; lengths are strictly constant). off: only "
        "limb lengths from a file.",
    )
    calibration_frames: int = advanced(
        100,
        ge=2,
        description="Number of a person's frames in one calibration (section 3.3.1; 100 in the "
        "published code).",
    )
    lookahead: Seconds = Field(
        10.0,
        ge=0.0,
        description="Time, s, that a person's first frames are held. They then get the calibrated "
        "lengths. 10 s instead of 100 frames reduces the error of the lengths by a quarter. 0 for "
        "real time: frames pass unchanged until calibration_frames have been seen.",
    )
    calibration_windows: tuple[tuple[float, float], ...] = advanced(
        (),
        description="Calibrate only in these time ranges, each (start, end) in s from the log's "
        "start. Choose times when people stand still and are well visible. Empty: the whole log.",
    )
    max_variation: float = advanced(
        0.2,
        gt=0.0,
        description="Quality gate: largest relative variation of a link's length (standard "
        "deviation / length; 0.2 in the published code). A calibration with a larger one is "
        "rejected.",
    )
    short_link: Metres = fixed(
        0.15,
        "max_variation treats links shorter than this, m, as if they had this length. The noise "
        "of a joint does not shrink with the link: a hand of 5 cm with 2 cm of noise would "
        "reject everybody.",
    )
    max_free: float = fixed(
        0.3,
        "Share of the links that may fail the quality gate. These links keep their measured "
        "lengths; the others become constant. If more links fail, the person is not calibrated. "
        "With 0 (paper), one failing link rejects the person, even a thumb that a single camera "
        "guesses.",
    )
    debias: bool = fixed(
        True,
        "Correct the lengths for noise, which makes links look longer. false: plain (robust) "
        "mean, as in the paper.",
    )
    refine: bool = fixed(
        True, "Continue to measure after the calibration, and adjust the lengths slowly."
    )
    max_refinement: ClassVar[float] = 0.01
    """Largest relative change of a length by refinement. It is small because a person's lengths are
    constant."""
    lengths: Literal["exact", "paper"] = fixed(
        "exact",
        "exact: lengths are rigid, and markers move as little as possible. paper: the weights "
        "of eq. 18, which correct small errors only in part. exact has the smaller joint error, "
        "and a coefficient of variation of the lengths below 0.001 instead of 0.035.",
    )
    max_length_error: Metres = advanced(
        0.1,
        gt=0.0,
        description="If a link's length is off by more than this, m, one of its ends is an outlier."
        " It is also the scale L of eq. 18, which the paper does not give. 0.1 is six times the "
        "standard deviation of a link between merged joints. On clean logs, 0.1 to 0.3 give the "
        "same result; of joints displaced by 15 or 30 cm, 0.1 repairs most.",
    )
    outliers: Literal["restore", "remove"] = fixed(
        "restore",
        "What happens to an outlier. restore: it moves to where the other markers and the "
        "lengths put it, so skeletons stay complete; a robust fit finds which end of a wrong "
        "link is the outlier. remove: the distal marker of a wrong link and all links that "
        "touch it become absent (paper).",
    )
    solver: Literal["lm", "ceres"] = Field(
        "lm",
        description="lm: compiled block Levenberg-Marquardt. ceres: the same energy with Ceres "
        "Solver, as in the paper; about 100 times slower, for comparison.",
    )
    tolerance: ClassVar[float] = 1e-06
    """The solver has converged when no coordinate moves farther than this, m, in a step."""

    @model_validator(mode="after")
    def _check_windows(self) -> OptimizeParams:
        for start, end in self.calibration_windows:
            if not 0.0 <= start < end:
                raise ValueError(f"calibration window ({start}, {end}): start must precede end")
        return self
