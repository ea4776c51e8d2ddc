"""`lpac fleet`: manage the robots' computers, all at once."""

from collections.abc import Callable

from lpac.cli.apps import new_app
from lpac.cli.fleet.everyday import (
    deploy,
    execute_on_all,
    land,
    logs,
    restart,
    rollback,
    start,
    stop,
)
from lpac.cli.fleet.field import doctor, up
from lpac.cli.fleet.keys import init, members, operator, revoke, rotate
from lpac.cli.fleet.membership import enroll, pull, swap
from lpac.cli.fleet.radio import radio
from lpac.cli.fleet.status import status

app = new_app("fleet", "Deploy to the robots, start and stop them.")
_COMMANDS: tuple[Callable[..., None], ...] = (
    deploy, rollback, start, stop, restart, land, status, logs,
    doctor, up, radio, enroll, swap, pull, init, operator, members, revoke, rotate,
)  # fmt: skip
for command in _COMMANDS:
    app.command()(command)
app.command("exec", context_settings={"allow_interspersed_args": False})(execute_on_all)
