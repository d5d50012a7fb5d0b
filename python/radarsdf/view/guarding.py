# SPDX-FileCopyrightText: 2026 the radarsdf authors
# SPDX-License-Identifier: MIT
"""Who may connect to the page's server, and what of a message is taken.

A web page of anybody runs in the same browser as ours. It can send to any address of this machine, and under a name of
its own if that name suddenly means 127.0.0.1. Browsers tell both: `Host` is the name that was asked for, `Origin` the
page that asks. What comes in a message is not trusted either, since one value serves all who look at the page.
"""

from __future__ import annotations

import ipaddress
import math
import socket
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictInt, StrictStr, ValidationError

MAX_MESSAGE_BYTES = 1 << 16
"""Of a message of the page. The longest that it sends has some hundred bytes."""
_FAR = 1e9  # no number of a page is larger: it shows the local frame of a map, m, in float32
_MAX_TEXT = 1000  # characters
_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_EVERYWHERE = ("0.0.0.0", "::", "")


def why_refused(hosts: Sequence[str], origins: Sequence[str], listening: str) -> str | None:
    """Why a request is refused, by its headers; None if it is not.

    Parameters
    ----------
    hosts, origins : sequence of str
        Values of the headers ``Host`` and ``Origin``, of which a request has one, and at most one.
    listening : str
        The host that the server was told to listen on. If that is every address of the machine, any address is right,
        and the name of the machine: only other names can be made to mean another machine.
    """
    if len(hosts) != 1 or not _is_ours(hosts[0], listening):
        return "the Host of the request is not this server"
    # Programs that are no browsers send none. A tunnel may have another port here, so it is not looked at.
    if len(origins) > 1 or (origins and origins[0].lower() not in _pages_of(hosts[0].lower())):
        return "the Origin of the request is another page"
    return None


def others_reach(host: str) -> bool:
    """Whether other machines reach a server that listens on this host, however it is written."""
    found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    return not all(ipaddress.ip_address(address[4][0]).is_loopback for address in found)


def _pages_of(host: str) -> tuple[str, str]:
    return f"http://{host}", f"https://{host}"


def _is_ours(host: str, listening: str) -> bool:
    try:
        parts = urlsplit(f"//{host}")
        name, _ = parts.hostname, parts.port
    except ValueError:
        return False
    if name is None or parts.netloc != host or "@" in host:
        return False
    if name in _LOOPBACK or _normal(name) == _normal(listening):
        return True
    return listening in _EVERYWHERE and (_address(name) is not None or name in _names_of_machine())


def _normal(name: str) -> str:
    address = _address(name)
    return name.lower() if address is None else str(address)


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def _names_of_machine() -> tuple[str, str]:
    name = socket.gethostname().lower()
    return name, f"{name}.local"


def _not_zero(vector: tuple[float, ...]) -> tuple[float, ...]:
    if math.hypot(*vector) < 1e-6:  # it has no direction
        msg = "it is zero"
        raise ValueError(msg)
    return vector


_Number = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-_FAR, le=_FAR)]
_Positive = Annotated[_Number, Field(gt=0)]
_Text = Annotated[StrictStr, Field(max_length=_MAX_TEXT)]
_Count = Annotated[StrictInt, Field(ge=0, le=1 << 31)]
_Pixel = tuple[_Number, _Number]
_Vector = tuple[_Number, _Number, _Number]
_Direction = Annotated[_Vector, AfterValidator(_not_zero)]
_Rotation = Annotated[tuple[_Number, _Number, _Number, _Number], AfterValidator(_not_zero)]


class _Message(BaseModel):
    """Fields of a message. Other versions of viser may add some, which are plain."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, bool | _Number | _Text | None]
    type: _Text


class _Dragged(_Message):
    name: _Text


class _Moved(_Dragged):
    wxyz: _Rotation
    position: _Vector


class _Clicked(_Message):
    event_type: Literal["click"]
    ray_origin: _Vector
    ray_direction: _Direction
    screen_pos: tuple[_Pixel]


class _Camera(_Message):
    wxyz: _Rotation
    position: _Vector
    fov: _Positive
    near: _Positive
    far: _Positive
    image_height: _Count
    image_width: _Count
    look_at: _Vector
    up_direction: _Direction


class _Stored(_Message):
    value: _Text | None
    error: _Text | None
    request_uuid: _Text


class _Update(BaseModel):
    model_config = ConfigDict(extra="forbid")
    value: Any  # nothing else of a control: viser would set any attribute of its own object


class _Controlled(_Message):
    uuid: _Text
    updates: _Update


# What pages of ours send. The others ask for uploads, public tunnels and the like.
_MESSAGES: dict[str, type[_Message]] = {
    "GuiUpdateMessage": _Controlled,
    "LocalStorageGetItemResponseMessage": _Stored,
    "ScenePointerMessage": _Clicked,
    "TransformControlsDragEndMessage": _Dragged,
    "TransformControlsDragStartMessage": _Dragged,
    "TransformControlsUpdateMessage": _Moved,
    "ViewerCameraMessage": _Camera,
}


def bounded(message: Any, controls: Mapping[str, Any]) -> dict[str, Any] | None:
    """What is taken of a message; None if it is left out.

    Parameters
    ----------
    message
        Whatever a client sent.
    controls
        The controls of the panel by their identity: a slider has a smallest and a largest value, a list its choices.
    """
    kind = message.get("type") if isinstance(message, dict) else None
    model = _MESSAGES.get(kind) if isinstance(kind, str) else None
    if model is None:
        return None
    try:
        checked = model.model_validate(message)
        if isinstance(checked, _Controlled):
            checked.updates.value = _of_control(checked.updates.value, controls.get(checked.uuid))
    except (ValueError, ValidationError):
        return None
    return checked.model_dump()


def _of_control(value: Any, control: Any) -> Any:
    """`value` as the control can have it: a number is moved into its range. Raises a ValueError for other types."""
    if control is None or getattr(control, "disabled", False):
        msg = "there is no such control"
        raise ValueError(msg)
    return _like(control.value, value, control)


def _like(old: Any, new: Any, control: Any) -> Any:
    if isinstance(old, bool) or isinstance(new, bool):
        if isinstance(old, bool) and isinstance(new, bool):
            return new
    elif isinstance(old, (int, float)) and isinstance(new, (int, float)) and math.isfinite(new):
        low, high = getattr(control, "min", None), getattr(control, "max", None)
        new = max(new, -_FAR if low is None else low)
        return type(old)(min(new, _FAR if high is None else high))
    elif isinstance(old, str) and isinstance(new, str) and len(new) <= _MAX_TEXT:
        if new in getattr(control, "options", [new]):
            return new
    elif isinstance(old, tuple) and isinstance(new, (list, tuple)) and len(old) == len(new):
        return tuple(_like(before, after, control) for before, after in zip(old, new, strict=True))
    msg = "it is not of the type of the control"
    raise ValueError(msg)
