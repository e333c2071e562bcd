"""One colour per person, the same in every output."""

from __future__ import annotations

RGB = tuple[int, int, int]

# Ten colours that stay apart on a dark ground and for colour-blind people.
PEOPLE: tuple[RGB, ...] = (
    (255, 140, 0),
    (0, 174, 255),
    (50, 220, 90),
    (255, 80, 160),
    (250, 220, 50),
    (160, 110, 255),
    (0, 220, 210),
    (255, 90, 70),
    (190, 230, 60),
    (210, 160, 255),
)


def person_colour(person: int) -> RGB:
    """Colour of an id."""
    return PEOPLE[person % len(PEOPLE)]
