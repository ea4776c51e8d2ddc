#!/usr/bin/env bash
# image.sh ARCH: the robot's image for arm64 or amd64, with docker buildx or, without it, buildah.
#   out/image/ARCH/root               the unpacked tree
#   out/image/lpac-edge-ARCH.tar.gz   the same for `docker load`
# BASE names another base image. Built only if something that goes in has changed.
set -euo pipefail
cd "$(dirname "$0")/../.."

arch=${1:-arm64}
base=${BASE:-docker.io/library/debian:bookworm-slim}
case $arch in arm64 | amd64) ;; *)
    echo "image: ARCH=$arch: must be arm64 or amd64" >&2
    exit 1 ;;
esac
name=lpac-edge:$arch
archive=out/image/lpac-edge-$arch.tar.gz
folder=out/image/$arch

inputs=$({
    echo "$base"
    # What the Dockerfile copies, and how it is built.
    find deploy/docker/{Dockerfile*,image.sh} $(sed -n 's/^!//p' deploy/docker/*.dockerignore) \
        -type f -not -path '*/__pycache__/*' -print0 |
        sort -z | xargs -0 sha256sum
} | sha256sum)
if [[ -f $archive && $(cat "$folder/inputs" 2>/dev/null) == "$inputs" ]]; then
    exit 0
fi

arguments=(--platform "linux/$arch" --build-arg "BASE=$base" --file deploy/docker/Dockerfile)
# Whom this machine trusts, the build does too: a proxy may stand between it and PyPI.
certificates=${SSL_CERT_FILE:-/etc/ssl/certs/ca-certificates.crt}
if [[ -f $certificates ]]; then
    arguments+=(--secret "id=certificates,src=$certificates")
fi

with_docker() {
    # Attestations would be files of the tree.
    export BUILDX_NO_DEFAULT_ATTESTATIONS=1
    arguments+=(--build-arg SOURCE_DATE_EPOCH=0)
    docker buildx build "${arguments[@]}" --output "type=local,dest=$made/root" .
    docker buildx build "${arguments[@]}" --tag "$name" --load .
    docker save --output "$made/image.tar" "$name"
}

with_buildah() {
    if ! buildah pull --quiet --policy missing "$base" >/dev/null 2>"$made/pull.log"; then
        # No registry here: the same base from Debian's own packages.
        if ! command -v mmdebstrap >/dev/null; then
            tail -n 1 "$made/pull.log" >&2
            echo "image: $base cannot be pulled; to make one: sudo apt install mmdebstrap" >&2
            exit 1
        fi
        mmdebstrap --quiet --variant=minbase --include=ca-certificates bookworm "$made/base.tar"
        container=$(buildah from scratch)
        buildah add --quiet "$container" "$made/base.tar" / >/dev/null
        buildah commit --quiet --rm "$container" "$base" >/dev/null
    fi
    # Older buildahs do not know the Dockerfile's BUILDPLATFORM.
    arguments+=(--build-arg "BUILDPLATFORM=linux/$(buildah info --format '{{.host.arch}}')")
    buildah build "${arguments[@]}" --isolation chroot --network host --layers --force-rm \
        --pull=never --timestamp 0 --ignorefile deploy/docker/Dockerfile.dockerignore \
        --tag "$name" --output "type=local,dest=$made/root" .
    buildah push --quiet "$name" "docker-archive:$made/image.tar:$name"
}

mkdir -p out/image
made=$(mktemp -d "$folder.XXXXXX")
trap 'rm -rf "$made"' EXIT
if docker buildx version >/dev/null 2>&1 && docker info >/dev/null 2>&1; then
    with_docker
elif command -v buildah >/dev/null; then
    with_buildah
else
    echo "image: neither docker buildx nor buildah is here: sudo apt install buildah" >&2
    exit 1
fi
gzip --no-name <"$made/image.tar" >"$made/image.tar.gz"
chmod 755 "$made" "$made/root"
echo "$inputs" >"$made/inputs"
mv "$made/image.tar.gz" "$archive"
rm -rf "$folder" "$made"/{image.tar,base.tar,pull.log}
mv "$made" "$folder"
