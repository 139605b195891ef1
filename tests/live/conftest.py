"""A live picture of a small harbour, fed by a replay or by sockets, and served over HTTP."""

import asyncio
import contextlib
import shutil
import socket
import ssl
import subprocess
import threading
import time
from typing import Any

import numpy as np
import pytest

from sameas.live.keeper import Keeper
from sameas.live.replay import Replay
from sameas.live.server import Access, application
from sameas.live.settings import LiveSource, OwnShip, Settings, WatchSettings
from sameas.tracks import Description, SensorErrors, Site
from sameas.tracks.reports import Reports

START_S = 1_714_560_000.0
SITE = (50.55, -0.95)
EVIL = "<img src=x onerror=alert(1)>"


def harbour(ships=5, until_s=200.0, seed=3):
    """AIS of ships, one of them named with markup, and radar targets at the same positions."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-3000.0, 3000.0, (ships, 2)), rng.normal(0.0, 5.0, (ships, 2))
    rows = {"ais": [], "radar": []}
    for t in np.arange(0.0, until_s, 2.0):
        for ship in range(ships):
            east, north = place[ship] + t * speed[ship]
            east_, north_ = east + 20.0 * rng.normal(), north + 20.0 * rng.normal()
            rows["radar"].append(
                [START_S + t, np.hypot(east_, north_), np.degrees(np.arctan2(east_, north_)), f"{ship}"]
            )
            if t % 6 == 0:
                rows["ais"].append([START_S + t, SITE[0] + north / 111_240.0, SITE[1] + east / 70_870.0,
                                    f"23500{ship}111", *speed[ship]])  # fmt: skip
    ais, radar = (list(zip(*rows[name], strict=True)) for name in ("ais", "radar"))
    names = [EVIL if mmsi == "235000111" else f"SHIP {mmsi[5]}" for mmsi in ais[3]]
    columns = dict(zip(("time_s", "lat_deg", "lon_deg", "mmsi", "vx_m_per_s", "vy_m_per_s"), ais, strict=True))
    return {
        "ais": Reports.of("ais", "ais", columns | {"track_id": ais[3], "name": names}),
        "radar": Reports.of(
            "radar", "table", dict(zip(("time_s", "range_m", "bearing_deg", "track_id"), radar, strict=True))
        ),
    }


def descriptions():
    radar = Description(
        "radar", "marine radar", site=Site(lat_deg=SITE[0], lon_deg=SITE[1]),
        errors=SensorErrors(range_m=20.0, range_share=0.0, bearing_deg=0.5, extent_m=5.0),
    )  # fmt: skip
    return [Description("ais", "ais"), radar]


def settings(**watch):
    usual: dict[str, Any] = {"register_every_s": 0.0, "own_ship": OwnShip(*SITE), "every_s": 0.25}
    return Settings({d.name: LiveSource(d) for d in descriptions()}, WatchSettings(**(usual | watch)))


def replay(pace=20.0, **made):
    return Replay(list(harbour(**made).items()), pace)


@pytest.fixture(scope="session")
def certificate(tmp_path_factory):
    """Certificate and key of a server that calls itself boat.local."""
    folder = tmp_path_factory.mktemp("tls")
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("needs openssl")
    subprocess.run(
        [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2",
         "-subj", "/CN=boat.local", "-addext", "subjectAltName=DNS:boat.local", "-keyout", folder / "key.pem",
         "-out", folder / "boat.pem"], check=True, capture_output=True,
    )  # fmt: skip
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(folder / "boat.pem", folder / "key.pem")
    return folder / "boat.pem", tls


@contextlib.contextmanager
def served(keeper, access=None):
    """URL of a uvicorn server of a running keeper, in its own thread."""
    import uvicorn

    class Server(uvicorn.Server):
        """A server without signal handlers, which only the main thread may install."""

        @contextlib.contextmanager
        def capture_signals(self):
            yield

    made = socket.socket()
    made.bind(("127.0.0.1", 0))
    config = uvicorn.Config(
        application(keeper, access or Access()), log_level="error", timeout_graceful_shutdown=1, ws="none"
    )
    server, over = Server(config), threading.Event()

    async def run():
        task = asyncio.create_task(server.serve(sockets=[made]))
        await keeper.run(until=over.is_set)
        server.should_exit = True
        await task

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    try:
        end = time.monotonic() + 120.0  # kernels may have to be compiled
        while keeper.situation is None or not server.started:
            assert time.monotonic() < end and thread.is_alive(), "it never ticked"
            time.sleep(0.02)
        yield f"http://127.0.0.1:{made.getsockname()[1]}"
    finally:
        over.set()
        thread.join(20.0)
        made.close()


@pytest.fixture
def keeper(tmp_path):
    # Long enough for a busy machine: a replay that has ended shows no ships.
    made = Keeper(settings(), tmp_path / "state", replay=replay(until_s=2400.0))
    yield made
    if made.store.journal is not None:
        made.close()
