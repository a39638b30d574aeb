"""Weights files: round trip, what is refused, the pretrained ones."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import struct

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from hybridvo.core import laboratory
from hybridvo.core.errors import CheckpointError, InputError, OutputError
from hybridvo.network.models import Models, load_weights
from hybridvo.network.pwvo import PWVO, PWVOOptions
from hybridvo.network.weights import (
    FORMAT,
    checksum,
    pretrained,
    save_weights,
    weights_file,
)
from hybridvo.pipeline import check_method
from hybridvo.run.commands.ready_methods import methods_to_run
from hybridvo_lab import WEIGHTS
from hybridvo_lab.methods import SELECTION
from hybridvo_lab.paper.networks import NetworkOptions, build_network

OPTIONS = NetworkOptions(width=0.125)
CARD = {"preset": "paper", "samples": 12, "figures": {"r_err_deg": 0.1}}


@pytest.fixture
def network():
    torch.manual_seed(0)
    return build_network(OPTIONS)


@pytest.fixture
def saved(tmp_path, network):
    return save_weights(tmp_path / "tiny.safetensors", network, CARD)


def rewrite(path, change=None, sealed=True, **header):
    """Write a file again with other tensors or another header; ``sealed``: with its checksum."""
    content = path.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8 : 8 + size])["__metadata__"] | header
    tensors = load_file(path)
    if change is not None:
        change(tensors)
    header = {k: v for k, v in header.items() if v is not None}
    if sealed and "checksum" in header:
        header["checksum"] = checksum(tensors, header)
    save_file(tensors, path, header)


def refuses(path, *parts):
    with pytest.raises(CheckpointError) as caught:
        load_weights(path)
    for part in (path.name, *parts):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    "options",
    [
        NetworkOptions(width=0.125, decoders=2, head_stride=2),
        NetworkOptions(width=0.125, uncertainty=False),
        NetworkOptions(kind="vonet-attention", width=0.125),
    ],
)
def test_round_trip(tmp_path, options):
    network = build_network(options)
    loaded, card = load_weights(
        save_weights(tmp_path / "x.safetensors", network, CARD)
    )
    assert card == CARD and loaded.options == options and not loaded.training
    for name, value in loaded.state_dict().items():
        true = network.state_dict()[name]
        assert value.dtype == torch.float32
        # half a step of 1/127 of an output's largest weight; of a bias the rounding of float16
        rows = true.flatten(1) if true.dim() > 1 else true.reshape(-1, 1)
        step = rows.abs().amax(1) / (127 if true.dim() > 1 else 1024)
        error = (value - true).reshape(rows.shape).abs().amax(1)
        assert (error <= 0.51 * step + 2**-24).all()


def test_missing_truncated_and_foreign_files(tmp_path, saved):
    refuses(tmp_path / "none.safetensors")
    content = saved.read_bytes()
    for broken in (
        *(
            content[: int(part * len(content))]
            for part in (0.0, 1e-4, 0.01, 0.5, 0.999)
        ),
        content + b"x",
        b"hello, this is a text file and no weights\n" * 10,
        struct.pack("<Q", 2**40) + b"{}",
        bytes(4096),
    ):
        saved.write_bytes(broken)
        refuses(saved)
    for header in (None, {"format": "pt"}):
        save_file({"weight": torch.zeros(3)}, saved, header)
        refuses(saved, FORMAT)


# --- the checksum ---------------------------------------------------------------------------------


def header_of(path):
    content = path.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    return 8 + size, json.loads(content[8 : 8 + size])["__metadata__"]


def test_one_changed_byte_anywhere_in_the_tensors_is_refused(saved):
    content = saved.read_bytes()
    start, _ = header_of(saved)
    for place in np.linspace(start, len(content) - 1, 12).astype(int):
        damaged = bytearray(content)
        damaged[place] ^= 1
        saved.write_bytes(damaged)
        refuses(saved, "checksum", "damaged", "again")
    saved.write_bytes(content)
    assert load_weights(saved)[1] == CARD


def test_a_changed_header_and_a_missing_or_foreign_checksum_are_refused(saved):
    content = saved.read_bytes()
    card = json.dumps(CARD | {"samples": 13})
    for header in (
        {"card": card},
        {"checksum": None},
        {"checksum": "0" * 64},
        {"note": "mine"},
    ):
        rewrite(saved, sealed=False, **header)
        refuses(saved, "checksum")
        saved.write_bytes(content)

    def swap(tensors):
        one, other = "encoder.stem.1.bias", "encoder.stem.2.bias"
        tensors[one], tensors[other] = tensors[other] + 1, tensors[one]

    rewrite(saved, swap, sealed=False)
    refuses(saved, "checksum")


def test_the_checksum_is_of_what_this_page_says(saved):
    """SHA-256 by hand: the header's texts by name, then name, type, shape and bytes of tensors."""
    total = hashlib.sha256()
    _, header = header_of(saved)
    stated = header.pop("checksum")
    for key in ("card", "format", "options"):
        total.update(json.dumps([key, header[key]]).encode())
    for name, value in sorted(load_file(saved).items()):
        total.update(
            json.dumps([name, str(value.dtype), list(value.shape)]).encode()
        )
        total.update(value.numpy().tobytes())
    assert stated == total.hexdigest()


def test_the_shipped_files_have_their_checksums(caplog):
    for path in pretrained().values():
        _, header = header_of(path)
        assert header["format"] == FORMAT and len(header["checksum"]) == 64, (
            path.name
        )
        load_weights(path)
    assert not caplog.text


def test_a_header_of_many_levels_is_refused(saved):
    for name in ("options", "card"):
        content = saved.read_bytes()
        rewrite(saved, **{name: "[" * 100_000})
        refuses(saved)
        saved.write_bytes(content)


class Bomb:
    def __init__(self, sentinel):
        self.sentinel = sentinel

    def __reduce__(self):
        return os.mkdir, (str(self.sentinel),)


@pytest.mark.parametrize(
    "write", [torch.save, lambda x, path: path.write_bytes(pickle.dumps(x))]
)
def test_pickles_are_refused_and_not_run(tmp_path, write):
    sentinel, path = tmp_path / "sentinel", tmp_path / "x.pt"
    write({"w": Bomb(sentinel)}, path)
    refuses(path)
    assert not sentinel.exists()


def test_tensors_that_are_not_the_networks(saved):
    def rename(tensors):
        del tensors["encoder.stem.0.bias"]
        tensors["surplus"] = torch.zeros(1)
        tensors["decoder.out.bias"] = torch.zeros(7)

    def spoil(tensors):
        tensors["encoder.layer3.2.conv1.bias"][0] = torch.nan

    content = saved.read_bytes()
    rewrite(saved, rename)
    refuses(saved, "encoder.stem.0.bias", "surplus")
    saved.write_bytes(content)
    rewrite(saved, spoil)
    refuses(saved, "encoder.layer3.2.conv1.bias")
    saved.write_bytes(content)
    rewrite(saved, options=json.dumps({"kind": "vonet", "width": 0.125}))
    refuses(saved, "head_rotation")


@pytest.mark.parametrize(
    "text",
    [None, "not json", '{"kind": [], "width": 1}', '{"kind": "pwvo", "depth": 3}'],
)
def test_damaged_options_and_cards(saved, text):
    content = saved.read_bytes()
    rewrite(saved, options=text)
    refuses(saved)
    if text is None or not text.startswith("{"):
        saved.write_bytes(content)
        rewrite(saved, card=text)
        refuses(saved)


def test_pretrained_weights_load_and_are_small():
    names = list(pretrained())
    assert set(names) == {"pwvo", *SELECTION}
    for name in names:
        network, card = load_weights(name)
        kind = "pwvo" if name == "pixelwise" else name.split("-")[0]
        assert network.options.kind.startswith(kind)
        assert {"command", "commit"} <= set(card)
        assert "held_out" in card or name == "pwvo"
        assert (
            json.loads(weights_file(name).with_suffix(".json").read_text()) == card
        )
    assert sum(weights_file(name).stat().st_size for name in names) < 15e6
    for name in ("pwvo-wid", "../pwvo", ""):
        with pytest.raises(CheckpointError, match="pwvo, pwvo-naive"):
            weights_file(name)


def test_the_papers_weights_are_a_package_of_their_own(monkeypatch):
    import hybridvo.network.weights as module

    assert weights_file("vonet").parent == WEIGHTS
    assert weights_file("pwvo").parent == module.PRETRAINED
    monkeypatch.setattr(laboratory, "_points", lambda group: {})
    assert list(pretrained()) == ["pwvo"]
    remedy = "pip install hybridvo-lab; in a clone of hybridvo: pip install ./hyb"
    with pytest.raises(CheckpointError, match=f"^vonet: .*{remedy}"):
        weights_file("vonet")
    ready, missing = methods_to_run(("all",))
    assert {"hybrid", "pwvo", "identity"} <= set(ready)
    assert "pnp-ransac" not in {*ready, *missing}
    with pytest.raises(InputError, match=remedy):
        check_method("pnp-ransac")


def test_a_method_refuses_the_weights_of_another_network(saved):
    of_paper = Models(weights={"pwvo-paper": saved}).network("pwvo-paper")
    assert of_paper.options == OPTIONS
    for name in ("pwvo", "vonet"):
        with pytest.raises(CheckpointError, match=f"expected .*{name}"):
            Models(weights={name: saved}).network(name)
    ours = weights_file("pwvo")
    with pytest.raises(CheckpointError, match="pwvo-hypotheses"):
        Models(weights={"pwvo-paper": ours}).network("pwvo-paper")


def test_our_pwvo_is_saved_and_read(tmp_path):
    torch.manual_seed(0)
    network = PWVO(PWVOOptions(width=0.25)).eval()
    path = save_weights(tmp_path / "ours.safetensors", network, CARD)
    again = PWVO.from_pretrained(path)
    assert again.options == network.options
    for name, value in network.state_dict().items():
        # in 8 bits: half a step of 127
        step = float(value.abs().max()) / 127 + 1e-6
        stored = again.state_dict()[name]
        torch.testing.assert_close(stored, value, atol=step, rtol=0)


def test_scales_that_fit_no_tensor_are_refused(saved):
    name = "head_motion.0.weight"
    content = saved.read_bytes()
    rewrite(saved, lambda tensors: tensors.pop(name))
    refuses(saved, name)
    saved.write_bytes(content)

    def cut(tensors):
        tensors[name + ":scale"] = tensors[name + ":scale"][:-1]

    rewrite(saved, cut)
    refuses(saved, name)


def test_saving_refuses_what_could_not_be_loaded(tmp_path, network):
    path = tmp_path / "x.safetensors"
    with pytest.raises(OutputError, match="nowhere"):
        save_weights(tmp_path / "nowhere" / "x.safetensors", network, CARD)
    with torch.no_grad():
        network.decoder.out.bias[0] = 1e6  # above float16
    with pytest.raises(InputError, match=r"decoder\.out\.bias"):
        save_weights(path, network, CARD)
    assert not path.exists()
