"""Which scenes belong to which official nuScenes split, and to which version of the tables.

The scene numbers are those that the nuScenes devkit publishes (``nuscenes.utils.splits``, version 1.2.0).
"""

from __future__ import annotations

from pathlib import Path

from lcf3d.errors import DatasetError, FormatError
from lcf3d.files import read_text

_SCENE_NUMBERS = {
    "mini_train": "61 553 655 757 796 1077 1094 1100",
    "mini_val": "103 916",
    "train": (
        "1-2 4-11 19-34 41-76 120-135 138-139 149-152 154-155 157-168 170-185 187-188 190-196 199-200 202-204 206-214 "
        "218-220 222 224-264 283-306 315-318 321 323-324 328 347-386 388-403 405-408 410-459 461-465 467-469 471-472 "
        "474-480 499-502 504-515 517-518 525-539 541-546 566 568 570-578 580 582-600 639-679 681 683-689 695-698 "
        "700-701 703-719 726-728 730-731 733-741 744 746-747 749-752 757-765 767-769 786-787 789-792 803-806 808-813 "
        "815-817 819-822 847-856 858 860-866 868-873 875-878 880 882-903 945 947 949 952-953 955-961 975-984 988-992 "
        "994-1025 1044-1058 1074-1102 1104-1110"
    ),
    "val": (
        "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
        "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
    ),
    "test": (
        "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 "
        "844-846 932-933 935-943 1026-1043"
    ),
}
SPLITS = tuple(_SCENE_NUMBERS)
"""Names of the official splits."""


def scenes_of_split(split: str) -> frozenset[str]:
    """Names of the scenes of an official split, or those listed in a text file, one a line.

    Args:
        split: one of `SPLITS`, or the path of a text file.

    Raises:
        DatasetError: it is neither.
    """
    if split in _SCENE_NUMBERS:
        return frozenset(f"scene-{number:04d}" for number in _expand(_SCENE_NUMBERS[split]))
    path = Path(split)
    if not path.is_file():
        raise DatasetError(
            f"split {split!r} is neither one of {', '.join(SPLITS)} nor a text file with one scene name a line"
        )
    try:
        lines = read_text(path).splitlines()
    except FormatError:
        raise DatasetError(f"{path} is not a text file with one scene name a line") from None
    return frozenset(line.strip() for line in lines if line.strip())


def default_split(version: str) -> str | None:
    """The split usually evaluated with tables of ``version`` (``v1.0-mini`` ...); None for a version of one's own."""
    return {"mini": "mini_val", "trainval": "val", "test": "test"}.get(version.rsplit("-", 1)[-1])


def _expand(ranges: str) -> list[int]:
    """The numbers of ``"1-2 5"``: 1, 2, 5."""
    numbers: list[int] = []
    for part in ranges.split():
        first, _, last = part.partition("-")
        numbers.extend(range(int(first), int(last or first) + 1))
    return numbers
