"""Places elsewhere that tests use: the memory, archives and a server that speaks S3."""

import logging
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

fsspec = pytest.importorskip("fsspec", reason="needs fsspec: pip install 'lcf3d[fleet]'")


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LCF3D_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def memory() -> Iterator[object]:
    files = fsspec.filesystem("memory")
    yield files
    for place in files.ls("/", detail=False):
        files.rm(place, recursive=True)


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    server = pytest.importorskip("moto.server", reason="needs moto: pip install 'lcf3d[dev]'")
    pytest.importorskip("s3fs", reason="needs s3fs: pip install 'lcf3d[fleet]'")
    running = server.ThreadedMotoServer(port=0, verbose=False)
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    running.start()
    yield f"http://127.0.0.1:{running.get_host_and_port()[1]}"
    running.stop()


@pytest.fixture
def s3(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """An S3 file system with the bucket ``drives``; the environment says where the server is."""
    import s3fs

    for name, value in (
        ("AWS_ENDPOINT_URL", s3_server),
        ("AWS_ACCESS_KEY_ID", "somebody"),
        ("AWS_SECRET_ACCESS_KEY", "secret"),
        ("AWS_DEFAULT_REGION", "us-east-1"),
    ):
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    files = s3fs.S3FileSystem()
    files.mkdir("drives")
    yield files
    files.rm("drives", recursive=True)
    s3fs.S3FileSystem.clear_instance_cache()


def upload(files: object, folder: Path, place: str) -> None:
    """Put a folder of this machine somewhere else."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            files.pipe(f"{place}/{path.relative_to(folder)}", path.read_bytes())  # type: ignore[attr-defined]


def pack(folder: Path, archive: Path) -> Path:
    """A folder as a zip file."""
    with zipfile.ZipFile(archive, "w") as packed:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                packed.write(path, os.fspath(path.relative_to(folder)))
    return archive
