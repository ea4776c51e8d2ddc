"""The robot's root file system, from Debian packages and wheels. It runs nothing of the target's.

Run in the Dockerfile's build stage, by a Python of the target's version:

    build_root.py fetch ARCH FETCHED            download what the locks name, with those hashes
    build_root.py assemble ARCH FETCHED ROOT    unpack, install, trim, compile
"""

import compileall
import hashlib
import json
import os
import py_compile
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
SOURCE = HERE.parents[1]
DEBIAN_LOCK = HERE / "debian.lock"
WHEELS_LOCK = HERE / "requirements.lock"
BUILD_LOCK = HERE / "build.lock"
# Wheels of the user's: sensors, policies, vehicles, radios, and what they need.
PACKAGES = HERE / "packages"
# Where BuildKit and buildah put the Dockerfile's secret.
CERTIFICATES = Path("/run/secrets/certificates")
# Debian's architecture -> the wheels', and the glibcs of theirs that the tree's (2.36) serves.
MACHINES = {"arm64": "aarch64", "amd64": "x86_64"}
MANYLINUX = ("_2_28", "_2_27", "_2_26", "_2_24", "_2_17", "2014")
# The tree has one date: two builds are equal, byte by byte.
EPOCH_S = 0

STDLIB = "usr/lib/python3.11"
SITE = "usr/lib/python3/dist-packages"
# Patterns, in the tree, of what no robot runs.
LEFT_OUT = (
    # Debian's, for people and for other programs. The licences in usr/share/doc/*/copyright stay.
    "usr/share/doc/*/[!c]*", "usr/share/doc/*/changelog*", "usr/share/[!d]*", "usr/lib/*/gconv",
    "usr/lib/valgrind", "usr/lib/binfmt.d", "etc/*",
    # The standard library's, for people; and what needs libraries that are not in the tree.
    *(f"{STDLIB}/{name}" for name in (
        "curses", "dbm", "distutils", "ensurepip", "idlelib", "lib2to3", "pydoc_data", "sqlite3",
        "test", "tkinter", "turtledemo", "turtle.py", "venv", "config-*", "_sysconfigdata_*",
        "lib-dynload/_curses*", "lib-dynload/_dbm*", "lib-dynload/_sqlite3*",
        "lib-dynload/readline*", "lib-dynload/nis*", "lib-dynload/_crypt*", "lib-dynload/_uuid*",
        "lib-dynload/_ssl*", "lib-dynload/_hashlib*", "lib-dynload/_test*", "lib-dynload/_xxtest*",
        "lib-dynload/_ctypes_test*", "lib-dynload/xxlimited*", "lib-dynload/ossaudiodev*",
    )),
    *(f"{SITE}/{name}" for name in (
        "bin", "**/test", "**/tests", "**/*.pyi", "**/*.pyx", "**/*.pxd", "**/*.h", "**/*.a",
        "*.dist-info/RECORD", "*.dist-info/REQUESTED", "*.dist-info/INSTALLER",
        "*.dist-info/direct_url.json",
        "numpy/f2py", "numpy/_core/include", "numpy/random/_examples",
        # onnxruntime's tools; and its library for C, which its Python module does not load.
        "onnxruntime/transformers", "onnxruntime/quantization", "onnxruntime/tools",
        "onnxruntime/datasets", "onnxruntime/capi/libonnxruntime.so*",
        # What only those tools import, what typer only draws with, what flight logs are not
        # compressed with.
        "google", "flatbuffers", "protobuf-*", "flatbuffers-*", "rich", "rich-*", "pygments",
        "pygments-*", "markdown_it", "markdown_it_py-*", "mdurl", "mdurl-*", "lz4",
        "lz4-*", "zstandard/_cffi*",
        # Of what PyNaCl brings only _cffi_backend is loaded.
        "cffi", "pycparser",
    )),
)  # fmt: skip
# Mount points of the unit's sandbox and of a container, and the release itself.
FOLDERS = (
    "dev", "etc", "proc", "release", "run/systemd", "sys", "tmp", "var/lib/lpac",
    "var/lib/private", "var/tmp",
)  # fmt: skip
FILES = {
    "etc/passwd": "root:x:0:0::/:/nonexistent\n"
    "lpac:x:65532:65532::/:/nonexistent\n"
    "nobody:x:65534:65534::/:/nonexistent\n",
    "etc/group": "root:x:0:\nlpac:x:65532:\nnogroup:x:65534:\n",
    "etc/hosts": "127.0.0.1 localhost\n::1 localhost\n",
    # What the unit mounts over; systemd would make it in the release.
    "run/systemd/notify": "",
}


class BuildError(Exception):
    """The tree cannot be built; the text says why and what to do."""


def fetch(architecture: str, folder: Path) -> None:
    """The packages of `debian.lock` in folder/debian, the wheels of `requirements.lock` in wheels.

    hatchling, which builds our own wheel, comes to folder/hatchling.
    """
    locked = read_debian_lock(DEBIAN_LOCK, architecture)
    debian = folder / "debian"
    debian.mkdir(parents=True)
    names = [f"{name}:{architecture}={version}" for name, (version, _) in locked.items()]
    # apt checks the archive's signature; the lock says that it is what we tried.
    try:
        _run("apt-get", "download", "--option=APT::Sandbox::User=root", *names, cwd=debian)
    except BuildError as error:
        raise BuildError(f"{error}; if the archive has newer versions: run `make lock`") from None
    for name, (version, sha256) in locked.items():
        (path,) = debian.glob(f"{name}_*.deb")
        if _sha256(path) != sha256:
            raise BuildError(f"{name} {version} is not what debian.lock names: run `make lock`")
    environment = {"PIP_CERT": str(CERTIFICATES)} if CERTIFICATES.exists() else {}
    hashes = ("--require-hashes", "--no-deps", "--only-binary=:all:", "--quiet")
    _pip("download", *hashes, *_target(architecture), "--requirement", WHEELS_LOCK,
         "--dest", folder / "wheels", environment=environment)  # fmt: skip
    _pip("install", *hashes, "--requirement", BUILD_LOCK, "--target", folder / "hatchling",
         environment=environment)  # fmt: skip


def assemble(architecture: str, fetched: Path, root: Path) -> None:
    """The tree of what was fetched, of edge and the command, and of the user's own packages."""
    root.mkdir()
    locked = read_debian_lock(DEBIAN_LOCK, architecture)
    for deb in sorted((fetched / "debian").iterdir()):
        _run("dpkg-deb", "--extract", deb, root)

    own = fetched / "own"
    _pip("wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", own, SOURCE,
         environment={"PYTHONPATH": str(fetched / "hatchling"), "SOURCE_DATE_EPOCH": "315532800"},
    )  # fmt: skip
    wheels = sorted((fetched / "wheels").iterdir())
    packages = sorted(PACKAGES.glob("*.whl"))
    install = ("install", "--quiet", "--no-index", "--only-binary=:all:", *_target(architecture),
               "--target", root / SITE)  # fmt: skip
    found = [f"--find-links={folder}" for folder in (fetched / "wheels", own)]
    try:
        if packages:
            _pip(*install, "--dry-run", *found, *packages)
        _pip(*install, "--no-deps", "--no-compile", *wheels, *own.iterdir(), *packages)
    except BuildError:
        if not packages:
            raise
        raise BuildError(
            "the wheels of deploy/docker/packages do not fit: see above; each must be for Python "
            f"3.11 on {architecture}, and no other version of what the image has; what they need "
            "must be there too"
        ) from None

    for pattern in LEFT_OUT:
        for path in list(root.glob(pattern)):
            _remove(path)
    # Not numpy.libs: auditwheel's edits do not survive it, and openblas then does not load.
    libraries = [p for p in (root / SITE).rglob("*.so*") if p.parent.name != "numpy.libs"]
    _run("strip", "--strip-unneeded", *libraries)
    for name in FOLDERS:
        (root / name).mkdir(parents=True, exist_ok=True)
    for name, text in FILES.items():
        (root / name).write_text(text)
    shutil.copy(HERE / "lpac", root / "usr/bin/lpac")
    versions = {
        "architecture": architecture,
        "debian": {n: {"version": v, "sha256": s} for n, (v, s) in locked.items()},
        "wheels": {
            path.name: {"sha256": _sha256(path)} for path in [*wheels, *own.iterdir(), *packages]
        },
    }
    (root / "usr/share/lpac").mkdir()
    (root / "usr/share/lpac/versions.json").write_text(json.dumps(versions, indent=1) + "\n")

    # By hash and unchecked: neither dates nor the robot's disk decide whether they are taken.
    if not compileall.compile_dir(
        root / "usr/lib", maxlevels=20, quiet=1, stripdir=root,
        invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH,
    ):  # fmt: skip
        raise BuildError("a Python file of the tree cannot be compiled")
    for path in [*root.rglob("*"), root]:
        if not path.is_symlink():
            # The loader too: the kernel runs it.
            executable = (
                path.is_dir() or path.parent.name == "bin" or path.name.startswith("ld-linux")
            )
            path.chmod(0o755 if executable else 0o644)
        os.utime(path, (EPOCH_S, EPOCH_S), follow_symlinks=False)


def read_debian_lock(path: Path, architecture: str) -> dict[str, tuple[str, str]]:
    """Package -> (version, sha256), for that architecture."""
    lines = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    return {name: (version, sha) for arch, name, version, sha in lines if arch == architecture}


def _target(architecture: str) -> list[str]:
    machine = MACHINES[architecture]
    platforms = [f"--platform=manylinux{glibc}_{machine}" for glibc in MANYLINUX]
    return [*platforms, "--python-version=3.11", "--implementation=cp", "--abi=cp311",
            "--abi=abi3", "--abi=none"]  # fmt: skip


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _pip(*arguments: object, environment: dict[str, str] | None = None) -> None:
    _run(sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-cache-dir", *arguments,
         environment={"PIP_ROOT_USER_ACTION": "ignore", **(environment or {})})  # fmt: skip


def _run(
    *command: object, cwd: Path | None = None, environment: dict[str, str] | None = None
) -> None:
    result = subprocess.run(
        list(map(str, command)), cwd=cwd, env=os.environ | (environment or {}), check=False
    )
    if result.returncode:
        raise BuildError(f"{' '.join(map(str, command[:3]))} failed: see above")


def main() -> None:
    """Run one of the steps."""
    step, architecture, fetched, *root = sys.argv[1:]
    try:
        if step == "fetch":
            fetch(architecture, Path(fetched))
        else:
            assemble(architecture, Path(fetched), Path(*root))
    except BuildError as error:
        sys.exit(f"image: {error}")


if __name__ == "__main__":
    main()
