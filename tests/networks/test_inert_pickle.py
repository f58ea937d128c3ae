"""Checkpoint files in the forms that training frameworks write: nothing that they name runs, every tensor comes out."""

from __future__ import annotations

import builtins
import importlib
import io
import os
import pickle
import subprocess
import sys
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from lcf3d.errors import DetectorError  # noqa: E402
from lcf3d.networks.checkpoints import read_state_dict  # noqa: E402
from lcf3d.networks.inert_pickle import Inert, LazyTensor, load_inert, require_memo  # noqa: E402


@pytest.fixture
def framework(monkeypatch):
    """A training framework's classes, which are gone when a file is read: its log names functions of its own class."""

    class HistoryBuffer:
        # pickled as getattr(HistoryBuffer, "mean"), as a bound or plain function of a class is
        @classmethod
        def mean(cls):
            raise AssertionError("called")

        class Entry:
            pass

        def __init__(self):
            self.history, self.methods = np.arange(3.0), {"mean": self.mean}
            self.last, self.entry = np.float32(2.5), HistoryBuffer.Entry()

    class ConfigDict(dict):
        pass

    names = {"HistoryBuffer": HistoryBuffer, "ConfigDict": ConfigDict}
    module = ModuleType("framework.logging")
    for name, value in names.items():
        value.__module__, value.__qualname__ = module.__name__, name
        setattr(module, name, value)
    HistoryBuffer.Entry.__module__, HistoryBuffer.Entry.__qualname__ = module.__name__, "HistoryBuffer.Entry"
    monkeypatch.setitem(sys.modules, "framework", ModuleType("framework"))
    monkeypatch.setitem(sys.modules, module.__name__, module)

    def content(state):
        optimizer = {"state": {0: {"momentum": torch.ones(5)}}, "param_groups": [{"lr": 0.1, "params": [0]}]}
        log = {"loss": HistoryBuffer(), "ids": {1, 2}, "random": torch.get_rng_state()}
        meta = {"cfg": ConfigDict(model=ConfigDict(type="SECOND"), lr=0.1), "epoch": 80}
        return {"meta": meta, "message_hub": log, "optimizer": optimizer, "state_dict": state}

    def save(path, state, **options):
        torch.save(content(state), path, **options)
        monkeypatch.delitem(sys.modules, module.__name__)

    return save


def a_state():
    torch.manual_seed(3)
    return torch.nn.Sequential(torch.nn.Conv2d(2, 3, 3), torch.nn.BatchNorm2d(3)).state_dict()


@pytest.mark.parametrize("protocol", [2, 3, 4])
@pytest.mark.parametrize("archive", [True, False])
def test_a_file_full_of_foreign_objects_gives_its_tensors(tmp_path, framework, archive, protocol):
    state, path = a_state(), tmp_path / "epoch.pth"
    framework(path, state, _use_new_zipfile_serialization=archive, pickle_protocol=protocol)
    found = read_state_dict(path)
    assert list(found) == list(state)
    assert all(torch.equal(found[name], value) and found[name].dtype == value.dtype for name, value in state.items())


@pytest.mark.parametrize("module", [b"numpy.core.multiarray", b"numpy._core.multiarray"])
def test_numpy_by_its_names_of_both_major_versions(tmp_path, framework, module):
    path = tmp_path / "epoch.pth"
    framework(path, a_state(), _use_new_zipfile_serialization=False)
    data = path.read_bytes()
    own = b"numpy._core.multiarray" if b"numpy._core.multiarray" in data else b"numpy.core.multiarray"
    assert own in data
    path.write_bytes(data.replace(own, module))
    assert list(read_state_dict(path)) == list(a_state())


def test_what_is_no_tensor_is_a_stand_in(tmp_path, framework):
    path = tmp_path / "epoch.pth"
    framework(path, a_state())
    content = load_inert(path)
    assert isinstance(content["message_hub"]["loss"], Inert)
    assert isinstance(content["meta"]["cfg"], Inert)
    assert content["meta"]["epoch"] == 80
    assert isinstance(content["optimizer"]["state"][0]["momentum"], LazyTensor)


@pytest.mark.parametrize("archive", [True, False])
@pytest.mark.parametrize(
    ("function", "argument"),
    [
        (os.mkdir, "made"),
        (importlib.import_module, "surprise"),
        (builtins.eval, "open('made', 'w')"),
        (os.system, "touch made"),
    ],
)
def test_nothing_in_the_file_is_executed(tmp_path, monkeypatch, function, argument, archive):
    (tmp_path / "surprise.py").write_text("open('made', 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)

    class Payload:
        def __reduce__(self):
            return function, (argument,)

    content = {"state_dict": {"weight": torch.ones(2)}, "log": Payload()}
    torch.save(content, tmp_path / "evil.pth", _use_new_zipfile_serialization=archive)
    assert list(read_state_dict(tmp_path / "evil.pth")) == ["weight"]
    assert not (tmp_path / "made").exists()
    assert "surprise" not in sys.modules


def test_a_tensor_that_is_not_even_read_costs_nothing_and_cannot_fail(tmp_path):
    path = tmp_path / "old.pth"
    content = {"state_dict": {"weight": torch.ones(2)}, "optimizer": torch.zeros(1000)}
    torch.save(content, path)
    data = bytearray(path.read_bytes())
    # damage the optimizer's numbers: the archive's check sum of them is never asked for
    place = bytes(data).index(bytes(4000))
    data[place + 100] = 1
    path.write_bytes(data)
    assert torch.equal(read_state_dict(path)["weight"], torch.ones(2))
    with pytest.raises(Exception, match="CRC"):
        load_inert(path)["optimizer"].load()


DTYPES = [
    torch.float32,
    torch.float64,
    torch.float16,
    torch.bfloat16,
    torch.int64,
    torch.int32,
    torch.uint8,
    torch.bool,
]


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    shape=st.lists(st.integers(0, 4), max_size=4),
    dtype=st.sampled_from(DTYPES),
    archive=st.booleans(),
    seed=st.integers(0, 99),
)
def test_every_kind_of_tensor_comes_back(tmp_path, shape, dtype, archive, seed):
    generator = torch.Generator().manual_seed(seed)
    base = (torch.rand([2, *shape], generator=generator) * 4).to(dtype)
    state = OrderedDict(
        whole=base,
        view=base[1],
        turned=base.transpose(0, -1),
        expanded=base[:1].expand(3, *shape),
        parameter=torch.nn.Parameter(base, requires_grad=False),
        module=base[0].clone(),
    )
    path = tmp_path / "state.pth"
    torch.save({"model": state}, path, _use_new_zipfile_serialization=archive)
    found = read_state_dict(path)
    assert list(found) == list(state)
    for name, value in state.items():
        assert found[name].dtype == value.dtype
        assert torch.equal(found[name], value.data)


@pytest.mark.parametrize("archive", [True, False])
def test_torn_and_changed_files_are_told_in_a_sentence(tmp_path, framework, archive):
    path = tmp_path / "epoch.pth"
    framework(path, a_state(), _use_new_zipfile_serialization=archive)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for end in np.linspace(0, len(whole) - 1, 30).astype(int):
        path.write_bytes(whole[:end])
        with pytest.raises(DetectorError, match="half downloaded"):
            read_state_dict(path)
    for _ in range(300):
        changed = bytearray(whole)
        for place in rng.integers(len(whole), size=rng.integers(1, 4)):
            changed[place] = rng.integers(256)
        path.write_bytes(changed)
        # whatever a file holds, it is read or it is told: any other error fails the test
        with suppress(DetectorError):
            read_state_dict(path)


class Huge:
    """A tensor that claims more numbers than the file holds."""

    def __init__(self, shape, stride):
        self.shape, self.stride = shape, stride

    def __reduce__(self):
        storage = torch.ones(2).storage()
        return torch._utils._rebuild_tensor_v2, (storage, 0, self.shape, self.stride, False, OrderedDict())


@pytest.mark.parametrize(("shape", "stride"), [((3,), (1,)), ((10**12,), (0,)), ((2,), (-1,)), ((2, 2), (1,))])
def test_a_tensor_beyond_its_data(tmp_path, shape, stride):
    torch.save({"weight": Huge(shape, stride)}, tmp_path / "huge.pth")
    with pytest.raises(DetectorError, match=r"half downloaded.*tensor"):
        read_state_dict(tmp_path / "huge.pth")


def test_other_archives(tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "pictures.zip", "w") as archive:
        archive.writestr("a/picture.png", b"1")
    with pytest.raises(DetectorError, match="torch did not write"):
        read_state_dict(tmp_path / "pictures.zip")


@pytest.mark.real
def test_the_shared_files_load(shared: Path):
    expected = {"0.weight", "0.bias", "1.weight", "1.bias", "1.running_mean", "1.running_var", "1.num_batches_tracked"}
    files = sorted((shared / "data" / "checkpoints").glob("*.pth"))
    assert len(files) == 7
    for path in files:
        found = read_state_dict(path)
        assert set(found) == expected
        assert found["0.weight"].shape == (4, 3, 3, 3)
        assert all(torch.isfinite(value.double()).all() for value in found.values())


@pytest.mark.real
def test_reading_imports_none_of_the_modules_named(shared: Path):
    code = (
        "import sys; from pathlib import Path; from lcf3d.networks.checkpoints import read_state_dict; "
        f"read_state_dict(Path({str(shared / 'data' / 'checkpoints' / 'mmengine_full_zip.pth')!r})); "
        "assert not [m for m in sys.modules if m.startswith(('mmengine', 'mmcv'))]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("put", [b"r\xff\xff\xff\x7f", b"p2147483647\n"])
def test_an_object_of_number_two_billion_makes_no_room_for_two_billion(put: bytes) -> None:
    file = io.BytesIO(b"before" + b"\x80\x02]" + put + b".")
    file.seek(6)
    with pytest.raises(pickle.UnpicklingError, match="object 2147483647 at byte"):
        require_memo(file)
    assert file.tell() == 6
    # what pickle writes itself passes, in every protocol, and so does what is none
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        require_memo(io.BytesIO(pickle.dumps([[i, str(i)] for i in range(70_000)], protocol)))
    require_memo(io.BytesIO(b"no pickle"))
