"""What `--drive` names, where frames come by themselves: standard input, sockets, phones, cameras."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qsl, unquote, urlsplit

from cap4d.bundle.bundle import Bundle
from cap4d.drive.convert import Converter
from cap4d.drive.live import Fill, LiveStream
from cap4d.drive.packet import Receiver
from cap4d.errors import ArgumentError
from cap4d.rig.store import load_rig

LOOPBACK = "127.0.0.1"
DEFAULT_PORTS = {"livelink": 11111, "vmc": 39539}  # what the senders send to, unless told otherwise
WIRE = ("tcp", "udp", "ws")  # lines of JSON, which can bear a token
LIVE = "-, tcp://, udp://, ws://, livelink://, vmc:// or webcam://"


def is_live(spec: str | None) -> bool:
    """Whether that is for `open_live`, an address of whatever kind, rather than a file."""
    return spec == "-" or (spec is not None and "://" in spec)


def open_live(
    spec: str,
    bundle: Bundle,
    *,
    template: Path | None = None,
    fps: float | None = None,
    sender: Path | None = None,
    fillers: Fill | None = None,
) -> LiveStream:
    """Opens a live source for an avatar; it receives while the stream is used as a context.

    Args:
        spec: `-`: lines of JSON on standard input; `tcp://HOST:PORT`, `udp://HOST:PORT`, `ws://HOST:PORT`:
            the same from senders who connect here; `livelink://HOST:PORT`, `vmc://HOST:PORT`: datagrams of
            phones and trackers; `webcam://0`. Without HOST this computer alone can send; with another address
            than its own, senders must bear `?token=X`, or, where they cannot, come `?from=ADDRESS`.
        bundle: The avatar.
        template: Neutral vertices of senders of vertices; see `open_source`.
        fps: None: live frames bear stamps.
        sender: Rig of a sender of another edition of FLAME; see `Converter`.
        fillers: See `LiveStream`.
    Raises:
        ArgumentError: No such source, an address that cannot be used, or one that is open to anybody.
        DataError: The template or the rig is not sound.
        ModuleNotFoundError: A package that the source needs is not installed.
    """
    if fps is not None:
        raise ArgumentError(f"fps: expected none for a live source, whose frames bear stamps, got {fps:g}")
    if template is not None and spec != "-" and _scheme(spec) not in WIRE:
        raise ArgumentError(f"template: goes with senders of vertices (-, tcp, udp, ws), got {spec}")
    convert = Converter(bundle, template=template, sender=None if sender is None else load_rig(sender))
    receiver = _receiver(spec, bundle)
    if spec == "-" or _scheme(spec) in WIRE:
        convert.prepare()  # a first frame that takes long would look like a line that does, for ten seconds
    return LiveStream(receiver, convert, fillers)


@dataclass(frozen=True)
class Address:
    """Where a socket source listens, and whom it believes.

    Args:
        host, port: To listen on.
        token: What senders must bear, or None.
        sender: The only address that may send, or None.
    """

    host: str
    port: int
    token: str | None = None
    sender: str | None = None


def parse_address(spec: str) -> Address:
    """`tcp://HOST:PORT?token=X` -> its parts.

    Raises:
        ArgumentError: It has other parts, or it is open to everybody on a network.
    """
    scheme = _scheme(spec)
    try:
        parts = urlsplit(spec)
        port, query = parts.port, dict(parse_qsl(parts.query, keep_blank_values=True))
    except ValueError as error:
        raise ArgumentError(f"drive: expected {scheme}://HOST:PORT, got {spec}: {error}") from None
    host, port = parts.hostname or LOOPBACK, DEFAULT_PORTS.get(scheme) if port is None else port
    key = "token" if scheme in WIRE else "from"
    if port is None or parts.path not in ("", "/") or parts.username is not None or set(query) - {key}:
        raise ArgumentError(
            f"drive: expected {scheme}://HOST:PORT or {scheme}://HOST:PORT?{key}=..., got {spec}"
        )
    if not query.get(key) and (key in query or not is_loopback(host)):
        raise ArgumentError(f"drive: expected ?{key}=..., as {host} can be reached by others, got {spec}")
    return Address(host, port, query.get("token"), query.get("from"))


def _receiver(spec: str, bundle: Bundle) -> Receiver:
    scheme = _scheme(spec)
    if spec == "-":
        from cap4d.drive.standard_input import StandardInputReceiver

        return StandardInputReceiver()
    if scheme == "webcam":
        from cap4d.drive.webcam import WebcamReceiver

        return WebcamReceiver(unquote(spec.removeprefix("webcam://")), bundle)
    if scheme in WIRE:
        return _wire_receiver(scheme, parse_address(spec))
    if scheme in DEFAULT_PORTS:
        return _datagram_receiver(scheme, parse_address(spec))
    raise ArgumentError(f"drive: expected {LIVE}, or a file, got {spec}")


def _wire_receiver(scheme: str, address: Address) -> Receiver:
    if scheme == "tcp":
        from cap4d.drive.tcp import TcpReceiver as WireReceiver
    elif scheme == "udp":
        from cap4d.drive.udp import UdpReceiver as WireReceiver
    else:
        from cap4d.drive.websocket import WebSocketReceiver as WireReceiver
    return WireReceiver(address.host, address.port, token=address.token)


def _datagram_receiver(scheme: str, address: Address) -> Receiver:
    if scheme == "livelink":
        from cap4d.drive.livelink import LiveLinkReceiver as DatagramReceiver
    else:
        from cap4d.drive.vmc import VmcReceiver as DatagramReceiver
    return DatagramReceiver(address.host, address.port, sender=address.sender)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches it; a name other than localhost counts as not."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _scheme(spec: str) -> str:
    return spec.partition("://")[0] if "://" in spec else ""
