"""Link of type "zenoh": zenoh alone, or with a multicast group for the robots' messages."""

from edge.core.schema import no_options
from edge.drivers.multicast import MulticastLink
from edge.drivers.zenoh_link import ZenohLink
from edge.messages.topics import MESSAGE, LinkSetting


def zenoh_link(setting: LinkSetting) -> ZenohLink | MulticastLink:
    """Open the link, a context manager, for `type = "zenoh"` in [link]; it has no options.

    Raises LinkError or ConfigError.
    """
    no_options("link", setting.options)
    zenoh = ZenohLink(
        fleet=setting.fleet,
        robot_id=setting.robot_id,
        listen=setting.listen,
        connect=setting.connect,
        scouting=setting.scouting,
        # Robots in a group need no zenoh connections to each other; grounds connect to them.
        autoconnect=setting.group is None,
        subscriptions={
            topic: callback
            for topic, callback in setting.subscriptions.items()
            if topic != MESSAGE or setting.group is None
        },
        tls=setting.tls,
        members=setting.members,
    )
    if setting.group is None:
        return zenoh
    return MulticastLink(
        setting.group,
        robot_id=setting.robot_id,
        on_message=setting.subscriptions.get(MESSAGE),
        zenoh=zenoh,
    )
