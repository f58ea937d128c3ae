"""The report over all frames of a run, served on this machine: pictures and scans are read when a frame is chosen."""

from __future__ import annotations

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
        raise ConfigError("serve needs starlette and uvicorn: pip install 'lcf3d[serve]'") from None
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


def serve(app: Any, port: int) -> None:
    """Serve an application until interrupted.

    Raises:
        ConfigError: uvicorn is not installed, or the port is in use.
    """
    import socket

    try:
        import uvicorn
    except ImportError:
        raise ConfigError("serve needs starlette and uvicorn: pip install 'lcf3d[serve]'") from None
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((HOST, port))
        except OSError as error:
            raise ConfigError(f"port {port} of {HOST} cannot be used ({error.strerror}); pass another --port") from None
        uvicorn.Server(uvicorn.Config(app, log_level="warning")).run(sockets=[listening])
