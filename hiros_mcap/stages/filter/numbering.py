"""Which step of whom is in a frame, and up to which step the look-ahead of a frame goes."""

from __future__ import annotations

from hiros_mcap.kernels.array_types import F1, I1, I2
from hiros_mcap.kernels.compile import entry

# Columns of FilterPast.progress.
STEPS = 0  # so far
ESTIMATED = 1  # steps whose estimates are written
KNOWN = 2  # steps up to the frame that is looked at
FIRST_TIME = 3  # ns
LAST_TIME = 4  # ns
PROGRESS = 5

# Columns of people in frames.
ROW = 0  # in the bank
STEP = 1


@entry
def number_steps(rows: I1, times: I1, progress: I2, steps: I1, seconds: F1) -> int:
    """Give numbers to the steps of P people, in the order of their frames.

    Parameters
    ----------
    rows : (P,) of the people in the bank; -1 = nobody.
    times : (P,) their own times, ns.
    progress : (B, PROGRESS), which goes on.
    steps, seconds : (P,) get the number of each step, and the time since the person's first one.
        There is no step (-1) where a person's times do not increase.

    Returns
    -------
    Most steps of a person whose estimates are not written.
    """
    most = 0
    for k in range(len(rows)):
        steps[k] = -1
        if rows[k] < 0:
            continue
        person = progress[rows[k]]
        if person[STEPS] == 0:
            person[FIRST_TIME] = times[k]
        elif times[k] <= person[LAST_TIME]:
            continue
        steps[k] = person[STEPS]
        seconds[k] = (times[k] - person[FIRST_TIME]) * 1e-9
        person[STEPS] += 1
        person[LAST_TIME] = times[k]
        most = max(most, person[STEPS] - person[ESTIMATED])
    return most


@entry
def find_ends(new: I2, frames: I1, leaving: I2, completing: I1, progress: I2, ends: I1) -> None:
    """Find how many steps of each person are known when the look-ahead of a frame is complete.

    Parameters
    ----------
    new, frames : (P, 3) the people of some new frames, and the frame of each.
    leaving, completing : (Q, 3) the people of the oldest frames, and the new frame that completes
        the look-ahead of each. ``new`` may be among them.
    progress : (B, PROGRESS), which goes on.
    ends : (Q,) gets the number of the first step that is not known yet.
    """
    for k in range(len(new)):
        if new[k, STEP] >= 0:
            progress[new[k, ROW], KNOWN] = progress[new[k, ROW], STEPS]
    for j in range(len(leaving)):
        if leaving[j, STEP] >= 0:
            progress[leaving[j, ROW], KNOWN] = progress[leaving[j, ROW], STEPS]
            progress[leaving[j, ROW], ESTIMATED] = leaving[j, STEP] + 1
    k = len(new) - 1
    for j in range(len(leaving) - 1, -1, -1):
        while k >= 0 and frames[k] > completing[j]:
            if new[k, STEP] >= 0:
                progress[new[k, ROW], KNOWN] = new[k, STEP]
            k -= 1
        if leaving[j, STEP] >= 0:
            ends[j] = progress[leaving[j, ROW], KNOWN]
