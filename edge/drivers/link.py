"""The type "zenoh" of robot.toml's [link]: zenoh, and with a group multicast beside it."""

from edge.core.schema import no_options
from edge.drivers.multicast import MulticastLink
from edge.drivers.zenoh_link import ZenohLink
from edge.identity.group import TOPICS_OF_GROUP
from edge.messages.topics import LinkSetting


def zenoh_link(setting: LinkSetting) -> ZenohLink | MulticastLink:
    """The type "zenoh" of robot.toml's [link], a context manager; it has no options.

    Raises LinkError or ConfigError.
    """
    no_options("link", setting.options)
    in_group = () if setting.group is None else TOPICS_OF_GROUP
    zenoh = ZenohLink(
        fleet=setting.fleet,
        robot_id=setting.robot_id,
        listen=setting.listen,
        connect=setting.connect,
        scouting=setting.scouting,
        # Robots in a group have nothing to say to each other besides: grounds call them.
        autoconnect=setting.group is None,
        subscriptions={t: c for t, c in setting.subscriptions.items() if t not in in_group},
        tls=setting.tls,
        members=setting.members,
    )
    if setting.group is None:
        return zenoh
    return MulticastLink(
        setting.group,
        robot_id=setting.robot_id,
        subscriptions=setting.subscriptions,
        zenoh=zenoh,
    )
