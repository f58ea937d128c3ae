import collections
import pickle

import numpy as np
import pytest

from lcf3d.errors import FormatError
from lcf3d.formats.pickles import read_arrays

RAN = []


class Trap:
    """Leaves a trace when it is unpickled as pickle would."""

    def __reduce__(self):
        return RAN.append, (1,)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_containers(tmp_path, protocol):
    content = [
        {
            "boxes": np.arange(14, dtype=np.float32).reshape(2, 7),
            "name": np.array(["Car", "Van"]),
            "objects": np.array(["Car", None], dtype=object),
            "score": np.float64(0.5),
            "order": np.asfortranarray(np.eye(3)[:, :2]),
            "frame_id": "000001",
            "empty": np.zeros((0, 7)),
            "raw": b"\xff\x00",
            "nested": collections.OrderedDict(a=(1, 2.0, None, True)),
        }
    ]
    path = tmp_path / "result.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    (found,) = read_arrays(path)
    for name in ("boxes", "name", "objects", "order", "empty"):
        np.testing.assert_array_equal(found[name], content[0][name])
        assert found[name].dtype == content[0][name].dtype
    assert (found["score"], found["raw"], found["nested"]) == (0.5, b"\xff\x00", {"a": (1, 2.0, None, True)})


def test_arrays_pickled_by_numpy_1(tmp_path):
    path = tmp_path / "old.pkl"
    path.write_bytes(pickle.dumps(np.arange(3), protocol=2).replace(b"numpy._core", b"numpy.core"))
    np.testing.assert_array_equal(read_arrays(path), [0, 1, 2])


def test_other_classes_are_refused_by_name_and_nothing_runs(tmp_path):
    path = tmp_path / "evil.pkl"
    path.write_bytes(pickle.dumps([np.arange(3), Trap()], protocol=2))
    with pytest.raises(FormatError, match=r"evil.pkl names builtins\.getattr|evil.pkl names __builtin__\.getattr"):
        read_arrays(path)
    path.write_bytes(b"cos\nsystem\n(S'touch ran'\ntR.")
    with pytest.raises(FormatError, match=r"names os\.system, but only numpy arrays"):
        read_arrays(path)
    # attributes of what is allowed are no way around
    path.write_bytes(b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.")
    with pytest.raises(FormatError, match=r"names numpy\.ndarray\.tofile"):
        read_arrays(path)
    path.write_bytes(pickle.dumps(np.random.default_rng(0), protocol=2))
    with pytest.raises(FormatError, match="names numpy"):
        read_arrays(path)
    assert not RAN


@pytest.mark.parametrize("content", [b"", b"not a pickle", pickle.dumps([np.arange(5)])[:-20], b"\x80\x04N"])
def test_damaged_files(tmp_path, content):
    path = tmp_path / "bad.pkl"
    path.write_bytes(content)
    with pytest.raises(FormatError, match="no pickle file, or a damaged one"):
        read_arrays(path)
    with pytest.raises(FormatError, match="does not exist"):
        read_arrays(tmp_path / "absent.pkl")


def test_a_bomb_of_object_numbers_is_refused(tmp_path):
    (tmp_path / "a.pkl").write_bytes(b"\x80\x02]r\xff\xff\xff\x7f.")
    with pytest.raises(FormatError, match="object 2147483647 at byte"):
        read_arrays(tmp_path / "a.pkl")
