"""How to install what an extra brings, from where this installation came: no index has it."""

import json
import shlex
from importlib.metadata import distribution
from urllib.parse import unquote, urlsplit

_NAME = "lpac-edge"


def install_command(extra: str) -> str:
    """The command for a shell. See PEP 610 for what pip notes of where a package came from."""
    noted = distribution(_NAME).read_text("direct_url.json")
    if noted is None:
        return f"pip install '{_NAME}[{extra}]'"
    origin = json.loads(noted)
    url: str = origin["url"]
    if origin.get("dir_info", {}).get("editable"):
        return f"pip install -e {shlex.quote(f'{unquote(urlsplit(url).path)}[{extra}]')}"
    if "vcs_info" in origin:
        # Some releases of pip take none without a host.
        url = url.replace("file:///", "file://localhost/")
        url = f"{origin['vcs_info']['vcs']}+{url}@{origin['vcs_info']['commit_id']}"
    return f"pip install {shlex.quote(f'{_NAME}[{extra}] @ {url}')}"
