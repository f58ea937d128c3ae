"""The report over all frames of a run, served on this machine: pictures and scans are read when a frame is chosen."""

from __future__ import annotations

from importlib.util import find_spec
from socket import SO_REUSEADDR, SOL_SOCKET, socket
from typing import Any

from lcf3d.datasets.base import Dataset
from lcf3d.errors import ConfigError
from lcf3d.evaluation.protocol import ResultSet
from lcf3d.evaluation.report import render
from lcf3d.evaluation.report_data import FrameSource, frame_picture, report_data

HOST = "127.0.0.1"
"""The only address that is served: nobody else's machine can ask."""
# everything that the page holds is on this machine, so that only the browser's memory limits it
_LIMIT_BYTES = 200_000_000
_MISSING = "serve needs starlette and uvicorn: pip install 'lcf3d[serve]'"


def report_app(results: ResultSet, dataset: Dataset, origin: dict[str, str]) -> Any:
    """An ASGI application with two answers: the page, and the pictures of one frame of the run.

    No file is served by its path: a frame is looked up by its id among those of the run.

    Args:
        results: measured.
        dataset: where images and scans come from.
        origin: for the foot of the page.

    Raises:
        ConfigError: starlette is not installed.
    """
    try:
        from starlette.applications import Starlette
        from starlette.middleware import Middleware
        from starlette.middleware.trustedhost import TrustedHostMiddleware
        from starlette.responses import HTMLResponse, JSONResponse
        from starlette.routing import Route
    except ImportError:
        raise ConfigError(_MISSING) from None
    study = results.study()
    data = report_data([study], dataset, 0, _LIMIT_BYTES)
    page = render(
        f"{study.heading}: {study.name}", [study], [results.tables()], (), {**data, "pictures_from": "picture"}, origin
    )
    frames, source = {frame["id"]: frame for frame in data["frames"]}, FrameSource(dataset)

    def index(request: Any) -> Any:
        return HTMLResponse(page)

    def picture(request: Any) -> Any:
        shown = frames.get(request.query_params.get("frame", ""))
        if shown is None:
            return JSONResponse({"error": "no such frame in this run"}, status_code=404)
        return JSONResponse(frame_picture(shown, source))

    # a page of another site that gets its own name to lead here is not answered
    hosts = Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])
    return Starlette(routes=[Route("/", index), Route("/picture", picture)], middleware=[hosts])


def listen(port: int) -> socket:
    """A socket that waits for browsers at a port of this machine; 0 takes any free one.

    Raises:
        ConfigError: uvicorn is not installed, or the port is in use.
    """
    if find_spec("uvicorn") is None or find_spec("starlette") is None:
        raise ConfigError(_MISSING)
    listening = socket()
    listening.setsockopt(SOL_SOCKET, SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
        # from now on browsers wait for an answer, and others find the port taken
        listening.listen()
    except OSError as error:
        listening.close()
        raise ConfigError(f"port {port} of {HOST} cannot be used ({error.strerror}); pass another --port") from None
    return listening


def serve(app: Any, listening: socket) -> None:
    """Serve an application until interrupted."""
    import uvicorn

    with listening:
        uvicorn.Server(uvicorn.Config(app, log_level="warning")).run(sockets=[listening])
