"""What BlueOS and Docker accept of an extension, as they document it.

Sources: BlueOS-docs, development/extensions (labels, register_service); the program of
BlueOS-Extensions-Repository, which makes the store's manifest from the labels; BlueOS,
core/services/kraken, which reads that manifest (one version that does not fit empties the whole
store), and core/services/helper, which lists the pages of running extensions; Docker Engine API
1.41, ContainerCreate.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from enum import Enum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

Email = Annotated[str, StringConstraints(pattern=r"^[^@\s]+@[^@\s]+\.[^@\s]+$")]
SemVer = Annotated[str, StringConstraints(pattern=r"^\d+\.\d+\.\d+(-[0-9A-Za-z.-]+)?$")]
Tag = Annotated[str, StringConstraints(pattern=r"^[a-z0-9-]+$")]
Url = Annotated[str, StringConstraints(pattern=r"^(https?://|mailto:)\S+$")]
TcpOrUdp = Annotated[str, StringConstraints(pattern=r"^\d+/(tcp|udp)$")]
Bind = Annotated[str, StringConstraints(pattern=r"^/[^:]*:/[^:]+(:(ro|rw)(,\w+)*)?$")]
DeviceRule = Annotated[str, StringConstraints(pattern=r"^[acb] (\d+|\*):(\d+|\*) [rwm]{1,3}$")]


class Strict(BaseModel):
    """No key that the other side does not know."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Author(Strict):
    name: str = Field(min_length=1)
    email: Email


class Company(Strict):
    name: str = Field(min_length=1)
    about: str | None = None
    email: Email | None = None


class ExtensionType(str, Enum):
    DEVICE_INTEGRATION = "device-integration"
    EXAMPLE = "example"
    THEME = "theme"
    OTHER = "other"
    TOOL = "tool"
    EDUCATION = "education"


class HostPort(Strict):
    HostIp: str = ""
    HostPort: str


class Restart(Strict):
    Name: Literal["", "no", "always", "unless-stopped", "on-failure"]
    MaximumRetryCount: int = 0


class Host(Strict):
    """The fields of the API that an extension has a use for."""

    NetworkMode: str = "bridge"
    PortBindings: dict[TcpOrUdp, list[HostPort]] = {}
    ExtraHosts: list[str] = []
    Binds: list[Bind] = []
    DeviceCgroupRules: list[DeviceRule] = []
    GroupAdd: list[str] = []
    CapAdd: list[str] = []
    CapDrop: list[str] = []
    SecurityOpt: list[str] = []
    Privileged: bool = False
    CpuPeriod: int = Field(0, ge=0)
    CpuQuota: int = 0
    CpuShares: int = 0
    CpusetCpus: str = ""
    Memory: int = Field(0, ge=0)
    MemorySwap: int = 0
    PidsLimit: int | None = None
    ShmSize: int = Field(0, ge=0)
    RestartPolicy: Restart | None = None


class Permissions(Strict):
    """Of the body of ContainerCreate, likewise."""

    ExposedPorts: dict[TcpOrUdp, dict[str, Any]] = {}
    Env: list[str] = []
    HostConfig: Host


class ExtensionVersion(Strict):
    """A version in the store's manifest."""

    version: SemVer
    type: ExtensionType
    authors: list[Author] = Field(min_length=1)
    company: Company
    filter_tags: list[Tag] = Field(max_length=10)
    website: Url
    """Optional to newer programs only."""
    support: Url | None = None
    docs: None = None
    """A link that the store's program reads as JSON: no address is."""
    extra_links: dict[str, Url]
    readme: Url
    requirements: str | None = None
    permissions: Permissions


class ServiceMetadata(Strict):
    """The answer to GET /register_service."""

    name: str
    description: str
    icon: str = Field(pattern=r"^mdi-[a-z0-9-]+$|^/")
    company: str
    version: str
    webpage: str
    api: str
    route: str | None = None
    new_page: bool | None = None
    extra_query: str | None = None
    avoid_iframes: bool | None = None
    works_in_relative_paths: bool | None = None
    extras: dict[str, str] | None = None


def manifest_entry(labels: Mapping[str, str]) -> ExtensionVersion:
    """What the store's program makes of an image's labels."""
    links = json.loads(labels.get("links", "{}"))
    return ExtensionVersion.model_validate(
        {
            "version": labels.get("version"),
            "type": ExtensionType(labels.get("type", "other")),
            "authors": json.loads(labels.get("authors", "[]")),
            "company": json.loads(labels.get("company", "null")),
            "filter_tags": json.loads(labels.get("tags", "[]")),
            "docs": links.pop("docs", links.pop("documentation", None)),
            "website": links.pop("website", None),
            "support": links.pop("support", None),
            "extra_links": links,
            "readme": labels.get("readme", "").replace("{tag}", labels.get("version", "")),
            "requirements": labels.get("requirements"),
            "permissions": json.loads(labels.get("permissions", "null")),
        }
    )
