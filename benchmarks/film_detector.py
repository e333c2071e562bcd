"""A real detector on film: MediaPipe Pose 0.10.14, run by the Python that has it.

    python film_detector.py PEOPLE OUT.npz VIDEO...

``film.py`` calls this with the Python of its own environment. MediaPipe's detector follows one
person. So each person has a detector of their own, which sees the rest of the picture as black
until it has found that person. People are looked for in parts of the picture, every half second.
Of each picture the PEOPLE who are largest are kept: a film is not of who works in the background.

OUT holds, by the video's number k: ``pixels_k`` (T, P, 33, 3) in px, with visibility;
``world_k`` (T, P, 33, 3) in m, with the hips in the middle; NaN = not found; and ``rates`` (K,) Hz.
"""

from __future__ import annotations

import sys
from typing import Any

import cv2  # noqa: TID253  (runs where OpenCV is)
import mediapipe  # type: ignore[import-not-found]
import numpy as np

JOINTS = 33
EVERY = 30  # frames
PARTS = ((1.0, 1), (0.6, 3), (0.35, 5))
"""Width of parts of the picture as a share of it, and how many of them."""
SAME = 0.15
"""Two detections are one person if the keypoints differ by less, in heights of the person."""
SURE = 0.6  # mean visibility of a person who is followed


def detector(*, still: bool) -> Any:
    """Make a detector of one person."""
    return mediapipe.solutions.pose.Pose(static_image_mode=still, model_complexity=1)


def found(pose: Any, picture: Any, left: int = 0) -> tuple[Any, Any] | None:
    """Return the keypoints (33, 3) and world landmarks (33, 3) of a picture of another's part."""
    result = pose.process(np.ascontiguousarray(picture[:, :, ::-1]))
    if result.pose_landmarks is None:
        return None
    height, width = picture.shape[:2]
    marks = result.pose_landmarks.landmark
    pixels = np.array([(left + p.x * width, p.y * height, p.visibility) for p in marks])
    return pixels, np.array([(p.x, p.y, p.z) for p in result.pose_world_landmarks.landmark])


def size_of(pixels: Any) -> float:
    return float(np.ptp(pixels[:, :2], axis=0).max())


def is_same(a: Any, b: Any) -> bool:
    apart = np.linalg.norm(a[:, :2] - b[:, :2], axis=1)
    return float(np.median(apart)) < SAME * min(size_of(a), size_of(b))


def everybody(still: Any, picture: Any) -> list[Any]:
    """Return the keypoints of the people in a picture, the largest first."""
    width, people = picture.shape[1], list[Any]()
    for share, count in PARTS:
        part = int(share * width)
        for left in np.linspace(0, width - part, count).astype(int).tolist():
            one = found(still, picture[:, left : left + part], left)
            if one is not None and one[0][:, 2].mean() > SURE:
                people.append(one[0])
    kept = list[Any]()
    for person in sorted(people, key=size_of, reverse=True):
        if not any(is_same(person, other) for other in kept):
            kept.append(person)
    return kept


def only(picture: Any, person: Any) -> Any:
    """Return the picture around a person; the rest is black."""
    low, high = person[:, :2].min(axis=0), person[:, :2].max(axis=0)
    margin = 0.15 * (high - low).max()
    (x, y), (right, bottom) = (low - margin).clip(0).astype(int), (high + margin).astype(int)
    out = np.zeros_like(picture)
    out[y:bottom, x:right] = picture[y:bottom, x:right]
    return out


def keypoints_of(video: str, people: int) -> tuple[Any, Any, float]:
    """Return keypoints and world landmarks (T, P, 33, 3), and the rate, Hz, of a video."""
    capture, still = cv2.VideoCapture(video), detector(still=True)
    followed, frames = list[Any](), list[list[Any]]()
    while True:
        there, picture = capture.read()
        if not there:
            break
        now = dict[Any, tuple[Any, Any]]()
        for pose in followed:
            one = found(pose, picture)
            if one is not None and not any(is_same(one[0], other[0]) for other in now.values()):
                now[pose] = one
        if len(frames) % EVERY == 0:
            for person in everybody(still, picture):
                if not any(is_same(person, other[0]) for other in now.values()):
                    pose = detector(still=False)
                    if (one := found(pose, only(picture, person))) is not None:
                        now[pose] = one
        followed = list(now)
        frames.append(list(now.values()))
    pixels, world = (np.full((len(frames), people, JOINTS, 3), np.nan) for _ in range(2))
    for t, seen in enumerate(frames):
        largest = sorted(seen, key=lambda one: size_of(one[0]), reverse=True)
        for k, one in enumerate(largest[:people]):
            pixels[t, k], world[t, k] = one
    return pixels, world, capture.get(cv2.CAP_PROP_FPS)


def main() -> None:
    people, out, *videos = sys.argv[1:]
    arrays: dict[str, Any] = {}
    rates = []
    for k, video in enumerate(videos):
        arrays[f"pixels_{k}"], arrays[f"world_{k}"], rate = keypoints_of(video, int(people))
        rates.append(rate)
    np.savez_compressed(out, rates=np.array(rates), **arrays)


if __name__ == "__main__":
    main()
