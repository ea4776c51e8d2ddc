"""A bundle that differs in any bit from the exported one is refused, and the fault is named."""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import numpy_helper

from edge.core.wire import FLOAT_PAYLOADS, PAYLOAD_TYPES
from edge.policy.bundle import (
    BUNDLE_ID,
    MANIFEST,
    Bundle,
    BundleError,
    load_bundle,
    make_bundle,
    write_bundle,
)
from edge.policy.golden import GOLDEN
from edge.policy.lpac.manifest import LpacManifest
from edge.policy.lpac.policy import LpacPolicy

GRAPHS = ("cnn.onnx", "gnn_1.onnx", "gnn_2.onnx", "action.onnx")


@pytest.fixture(scope="module")
def archive(shipped_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bundle") / "policy.zip"
    write_bundle(shipped_bundle, path)
    return path


def with_files(bundle: Bundle, **changed: bytes) -> dict[str, bytes]:
    kept = {n: c for n, c in bundle.files.items() if n not in (MANIFEST, BUNDLE_ID)}
    return {**kept, **{name.replace("__", "."): content for name, content in changed.items()}}


def test_directory_and_archive_hold_the_same_bundle(shipped_bundle: Bundle, archive: Path) -> None:
    assert load_bundle(archive) == shipped_bundle
    again = archive.with_name("again.zip")
    write_bundle(load_bundle(archive), again)
    assert again.read_bytes() == archive.read_bytes()
    folder = archive.with_name("folder")
    write_bundle(shipped_bundle, folder)
    write_bundle(shipped_bundle, folder)  # replaces itself
    assert load_bundle(folder) == shipped_bundle


def test_what_older_versions_do_not_know_is_not_in_bundles_that_do_not_need_it(
    shipped_bundle: Bundle, exploring_bundle: Bundle
) -> None:
    again = make_bundle(shipped_bundle.manifest, with_files(shipped_bundle))
    assert again == shipped_bundle
    perception = json.loads(exploring_bundle.files[MANIFEST])["perception"]
    assert perception.pop("unseen_as_nan") is True
    assert perception == json.loads(shipped_bundle.files[MANIFEST])["perception"]


@pytest.mark.parametrize("channels", ["four", "five"])
def test_images_and_the_local_map_must_agree(
    channels: str, shipped_bundle: Bundle, exploring_bundle: Bundle
) -> None:
    manifest = (exploring_bundle if channels == "five" else shipped_bundle).manifest
    assert manifest.perception is not None
    told = channels == "four"
    perception = dataclasses.replace(manifest.perception, unseen_as_nan=told)
    with pytest.raises(BundleError, match=f"unseen_as_nan = {told}: must be {not told}"):
        LpacManifest.of(dataclasses.replace(manifest, perception=perception))


def test_the_shipped_bundle_computes_what_torch_computed(shipped_bundle: Bundle) -> None:
    checks = list(LpacPolicy(shipped_bundle).verify())
    assert [check.name for check in checks] == [*GRAPHS, "swarm"]
    assert all(check.passed for check in checks), checks


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_one_flipped_bit_anywhere_is_found(
    data: st.DataObject, shipped_bundle: Bundle, tmp_path_factory: pytest.TempPathFactory
) -> None:
    name = data.draw(st.sampled_from(sorted(shipped_bundle.files)))
    content = bytearray(shipped_bundle.files[name])
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    folder = tmp_path_factory.mktemp("flipped")
    for other, unchanged in shipped_bundle.files.items():
        (folder / other).write_bytes(bytes(content) if other == name else unchanged)
    with pytest.raises(BundleError, match=name if name != BUNDLE_ID else MANIFEST):
        load_bundle(folder)


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_one_flipped_bit_anywhere_in_the_archive_is_found(
    data: st.DataObject, archive: Path
) -> None:
    content = bytearray(archive.read_bytes())
    # The zip's own structure is at the end and between the files: test there more often.
    size = len(content)
    place = data.draw(st.one_of(st.integers(0, size - 1), st.integers(size - 700, size - 1)))
    content[place] ^= 1 << data.draw(st.integers(0, 7))
    flipped = archive.with_name("flipped.zip")
    flipped.write_bytes(bytes(content))
    with pytest.raises(BundleError):
        load_bundle(flipped)


def scaled(graph: bytes, tensor: str, part: slice) -> bytes:
    """The graph with some rows of one weight times 1.01."""
    model = onnx.load_from_string(graph)
    (weight,) = (w for w in model.graph.initializer if w.name == tensor)
    values = numpy_helper.to_array(weight).copy()
    values[part] *= np.float32(1.01)
    weight.CopyFrom(numpy_helper.from_array(values, tensor))
    changed: bytes = model.SerializeToString()
    return changed


def weights(bundle: Bundle) -> list[tuple[str, str, slice]]:
    """Graph, tensor and rows of every weight and bias of every graph, the taps one by one."""
    found = []
    for name in GRAPHS:
        for weight in onnx.load_from_string(bundle.files[name]).graph.initializer:
            assert weight.data_type == onnx.TensorProto.FLOAT
            if weight.name == "taps":
                taps = LpacManifest.of(bundle.manifest).geometry.hops + 1
                rows = weight.dims[0] // taps
                found += [(name, "taps", slice(k * rows, (k + 1) * rows)) for k in range(taps)]
            else:
                found.append((name, weight.name, slice(None)))
    return found


def test_a_weight_scaled_by_a_hundredth_with_mended_hashes_is_found_and_named(
    shipped_bundle: Bundle,
) -> None:
    altered = weights(shipped_bundle)
    assert {graph for graph, _, _ in altered} == set(GRAPHS) and len(altered) == 8 + 2 * 5 + 4
    for graph, tensor, part in altered:
        content = scaled(shipped_bundle.files[graph], tensor, part)
        files = with_files(shipped_bundle, **{graph: content})
        mended = make_bundle(shipped_bundle.manifest, files)
        failed = [check.name for check in LpacPolicy(mended).verify() if not check.passed]
        assert graph in failed, (graph, tensor, part)
        assert set(failed) <= {graph, "swarm"}


def test_a_graph_that_does_not_fit_the_manifest_is_named(shipped_bundle: Bundle) -> None:
    gnn_1 = shipped_bundle.files["gnn_1.onnx"]
    swapped = make_bundle(
        shipped_bundle.manifest, with_files(shipped_bundle, **{"gnn_2.onnx": gnn_1})
    )
    with pytest.raises(BundleError, match=r"gnn_2\.onnx: the input is .*34.*256"):
        LpacPolicy(swapped)
    broken = make_bundle(
        shipped_bundle.manifest, with_files(shipped_bundle, **{"gnn_2.onnx": gnn_1[:1000]})
    )
    with pytest.raises(BundleError, match=r"gnn_2\.onnx: onnxruntime cannot load it"):
        LpacPolicy(broken)


@pytest.mark.parametrize("golden", [b"", b"PK\x03\x04 not a zip"])
def test_unreadable_golden_vectors_are_named(shipped_bundle: Bundle, golden: bytes) -> None:
    bundle = make_bundle(shipped_bundle.manifest, with_files(shipped_bundle, **{GOLDEN: golden}))
    with pytest.raises(BundleError, match=r"golden\.npz"):
        list(LpacPolicy(bundle).verify())


def resealed(bundle: Bundle, folder: Path, change: dict[str, object]) -> Path:
    """Write the bundle with a changed manifest and its new id."""
    manifest = json.loads(bundle.files[MANIFEST])
    manifest.update(change)
    write_bundle(bundle, folder)
    text = json.dumps(manifest)
    (folder / MANIFEST).write_text(text)
    (folder / BUNDLE_ID).write_text(hashlib.sha256(text.encode()).hexdigest() + "\n")
    return folder


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"schema": 2}, "schema = 2: this version reads 1"),
        ({"schema": "1"}, "schema = '1': must be a whole number"),
        ({"colour": "red"}, "unknown key 'colour'; known are opset, geometry, images"),
        ({"geometry": {"hops": 0, "feature_sizes": [34, 256]}}, "hops = 0: must be at least 1"),
        ({"geometry": {"hops": 3}}, "geometry: feature_sizes is missing"),
        ({"images": None}, "images and perception must be given together"),
        ({"training": {"max_speed": -5.0, "time_step": 0.2}}, "max_speed = -5.0: must be above 0"),
        ({"files": {}}, "action.onnx does not belong to the bundle"),
        ({"payload_types": ["int4"]}, "payload_types[0] = 'int4': allowed are 'float32'"),
        ({"opset": 20.5}, "opset = 20.5: must be a whole number"),
        ({"family": "other"}, "its family is 'other', not 'lpac'"),
    ],
)
def test_an_impossible_manifest_is_named(
    shipped_bundle: Bundle, tmp_path: Path, change: dict[str, object], text: str
) -> None:
    with pytest.raises(BundleError) as error:
        LpacPolicy(load_bundle(resealed(shipped_bundle, tmp_path / "bundle", change)))
    assert text in str(error.value)
    assert "\n" not in str(error.value)


def test_a_bundle_that_lacks_a_graph_of_its_network_is_refused(shipped_bundle: Bundle) -> None:
    files = with_files(shipped_bundle)
    del files["gnn_2.onnx"]
    bundle = make_bundle(shipped_bundle.manifest, files)
    with pytest.raises(BundleError, match=r"files = .*: must be action\.onnx, cnn\.onnx, gnn_1\."):
        LpacPolicy(bundle)


def test_missing_and_foreign_files_are_named(shipped_bundle: Bundle, tmp_path: Path) -> None:
    folder = tmp_path / "bundle"
    for name in shipped_bundle.files:
        write_bundle(shipped_bundle, folder)
        (folder / name).unlink()
        with pytest.raises(BundleError, match=f"{name} is missing"):
            load_bundle(folder)
        (folder / name).write_bytes(shipped_bundle.files[name])
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(BundleError, match=r"notes\.txt does not belong"):
        load_bundle(folder)


def test_what_is_no_bundle_is_said_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.zip").write_text("hello")
    for name, text in (
        ("absent", "there is no such file"),
        ("empty", "manifest.json is missing: not a bundle"),
        ("text.zip", "neither a bundle's directory nor its archive"),
    ):
        with pytest.raises(BundleError, match=text):
            load_bundle(tmp_path / name)


def test_writing_never_destroys_something_else(shipped_bundle: Bundle, tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    for path in (home, home / "thesis.tex"):
        with pytest.raises(BundleError, match=str(path)):
            write_bundle(shipped_bundle, path)
    (home / "manifest.json").write_text("{}")  # web pages have one too
    (tmp_path / "photos.zip").write_bytes(b"PK")
    for path in (home, tmp_path / "photos.zip"):
        with pytest.raises(BundleError, match="exists and is not a bundle"):
            write_bundle(shipped_bundle, path)
    assert (home / "thesis.tex").read_text() == "years of work"
    assert (tmp_path / "photos.zip").read_bytes() == b"PK"


def test_how_payloads_may_be_encoded_is_written_where_it_is_not_as_ever(
    shipped_bundle: Bundle,
) -> None:
    assert shipped_bundle.manifest.payload_types == FLOAT_PAYLOADS
    assert b"payload_types" not in shipped_bundle.files["manifest.json"]
    more = dataclasses.replace(shipped_bundle.manifest, payload_types=PAYLOAD_TYPES)
    sealed = make_bundle(more, with_files(shipped_bundle))
    assert sealed.manifest.payload_types == PAYLOAD_TYPES


def test_a_bundle_without_perception_says_so(shipped_bundle: Bundle) -> None:
    files = with_files(shipped_bundle)
    del files["cnn.onnx"]
    manifest = dataclasses.replace(
        shipped_bundle.manifest,
        perception=None,
        parameters=shipped_bundle.manifest.parameters | {"images": None},
    )
    policy = LpacPolicy(make_bundle(manifest, files))
    with pytest.raises(BundleError, match="has no perception"):
        policy.image_features(np.zeros((1, 4, 32, 32), np.float32))
