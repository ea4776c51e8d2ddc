"""How a test enters an image without an engine."""

from pathlib import Path


def inside(tree: Path, release: Path, *arguments: str) -> list[str]:
    """A command line that runs `arguments` as the unit does: in the tree, under no known user.

    `release` is seen as /release. The mounts are gone with the process.
    """
    script = """
        tree=$1 release=$2; shift 2
        mount --bind "$release" "$tree/release"
        mount -t proc proc "$tree/proc"
        mount -t sysfs sys "$tree/sys"
        mount -t tmpfs tmp "$tree/tmp"
        mount --rbind /dev "$tree/dev"
        exec chroot --userspec 65532:65532 "$tree" "$@"
    """
    return ["unshare", "--mount", "sh", "-ec", script, "sh", str(tree), str(release), *arguments]
