from __future__ import annotations

import json
import os
import pickle
import struct

import pytest
import torch
from safetensors.torch import load_file, save_file

from hybridvo.errors import CheckpointError, InputError, OutputError
from hybridvo.network import weights
from hybridvo.network.pwvo import NetworkOptions, build_network
from hybridvo.network.weights import FORMAT, load_weights, pretrained, save_weights

OPTIONS = NetworkOptions(width=0.125)
CARD = {"preset": "paper", "samples": 12, "figures": {"r_err_deg": 0.1}}


@pytest.fixture
def network():
    torch.manual_seed(0)
    return build_network(OPTIONS)


@pytest.fixture
def saved(tmp_path, network):
    return save_weights(tmp_path / "tiny.safetensors", network, OPTIONS, CARD)


def rewrite(path, change=None, metadata=None):
    """Write a file again with other tensors or another header."""
    content = path.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8 : 8 + size])["__metadata__"]
    tensors = load_file(path)
    if change is not None:
        change(tensors)
    header.update(metadata or {})
    save_file(tensors, path, {k: v for k, v in header.items() if v is not None})


@pytest.mark.parametrize(
    "options",
    [
        OPTIONS,
        NetworkOptions(width=0.125, decoders=2, head_stride=2),
        NetworkOptions(width=0.125, uncertainty=False),
        NetworkOptions(kind="vonet", width=0.125),
        NetworkOptions(kind="vonet-attention", width=0.125),
    ],
)
def test_round_trip_is_exact(tmp_path, options):
    torch.manual_seed(1)
    network = build_network(options)
    path = save_weights(tmp_path / "x.safetensors", network, options, CARD)
    loaded, card = load_weights(path)
    assert card == CARD
    assert loaded.options == options
    assert not loaded.training
    assert all(p.requires_grad and p.device.type == "cpu" for p in loaded.parameters())
    state = loaded.state_dict()
    assert list(state) == list(network.state_dict())
    for name, value in network.state_dict().items():
        assert torch.equal(state[name], value)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float16", 2**-11), ("bfloat16", 2**-8)])
def test_half_storage_comes_back_as_float32(tmp_path, network, dtype, tolerance):
    small = save_weights(tmp_path / "half.safetensors", network, OPTIONS, CARD, dtype=dtype)
    full = save_weights(tmp_path / "full.safetensors", network, OPTIONS, CARD)
    assert small.stat().st_size < 0.6 * full.stat().st_size
    for name, value in load_weights(small)[0].state_dict().items():
        assert value.dtype == torch.float32
        # Rounding to nearest: half a unit in the last place; 2^-24 where float16 is subnormal.
        torch.testing.assert_close(value, network.state_dict()[name], rtol=tolerance, atol=2**-24)


def test_saving_is_atomic_and_leaves_nothing_behind(saved, network, monkeypatch):
    before = saved.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(weights.os, "replace", fail)
    with pytest.raises(OutputError, match="No space left"):
        save_weights(saved, network, OPTIONS, {"other": 1})
    assert saved.read_bytes() == before
    assert os.listdir(saved.parent) == [saved.name]


def test_saving_into_a_missing_folder_is_an_output_error(tmp_path, network):
    with pytest.raises(OutputError, match="nowhere"):
        save_weights(tmp_path / "nowhere" / "x.safetensors", network, OPTIONS, CARD)


def test_saving_refuses_what_could_not_be_loaded(tmp_path, network):
    path = tmp_path / "x.safetensors"
    with pytest.raises(InputError, match="is not of"):
        save_weights(path, network, NetworkOptions(width=0.25), CARD)
    with pytest.raises(InputError, match="known: float16"):
        save_weights(path, network, OPTIONS, CARD, dtype="int8")
    for card in ({"x": object()}, {"x": float("nan")}):
        with pytest.raises(InputError, match="JSON"):
            save_weights(path, network, OPTIONS, card)
    with torch.no_grad():
        network.decoder.out.bias[0] = 1e6  # above float16
    with pytest.raises(InputError, match=r"decoder\.out\.bias"):
        save_weights(path, network, OPTIONS, CARD, dtype="float16")
    assert not path.exists()


def refuses(path, *parts):
    with pytest.raises(CheckpointError) as caught:
        load_weights(path)
    for part in (path.name, *parts):
        assert part in str(caught.value)


def test_missing_file_and_folder(tmp_path):
    refuses(tmp_path / "none.safetensors", "no such")
    folder = tmp_path / "folder.safetensors"
    folder.mkdir()
    refuses(folder, "no such")


@pytest.mark.parametrize("share", [0.0, 1e-4, 0.01, 0.5, 0.999])
def test_truncated(saved, share):
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])
    refuses(saved, "safetensors")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"hello, this is a text file and no weights\n" * 10,
        struct.pack("<Q", 2**40) + b"{}",
        struct.pack("<Q", 2**64 - 1) + b"{}" * 50,
        struct.pack("<Q", 2) + b"{}",
        struct.pack("<Q", 4) + b"[[[[",
        bytes(4096),
    ],
)
def test_not_safetensors(tmp_path, content):
    path = tmp_path / "x.safetensors"
    path.write_bytes(content)
    refuses(path)


def test_appended_bytes(saved):
    saved.write_bytes(saved.read_bytes() + b"x")
    refuses(saved)


class Bomb:
    def __init__(self, sentinel):
        self.sentinel = sentinel

    def __reduce__(self):
        return os.mkdir, (str(self.sentinel),)


@pytest.mark.parametrize("writer", ["pickle", "torch", "torch-legacy"])
def test_pickles_are_refused_and_not_run(tmp_path, writer):
    sentinel, path = tmp_path / "sentinel", tmp_path / "x.pt"
    if writer == "pickle":
        path.write_bytes(pickle.dumps(Bomb(sentinel)))
    else:
        zipped = writer == "torch"
        torch.save({"w": Bomb(sentinel)}, path, _use_new_zipfile_serialization=zipped)
    refuses(path, "Pickled checkpoints")
    assert not sentinel.exists()


def test_foreign_safetensors(tmp_path):
    path = tmp_path / "x.safetensors"
    save_file({"weight": torch.zeros(3)}, path)
    refuses(path, FORMAT)
    save_file({"weight": torch.zeros(3)}, path, {"format": "pt"})
    refuses(path, FORMAT, "'pt'")


def test_missing_extra_and_misshapen_tensors_are_listed(saved):
    def change(tensors):
        del tensors["encoder.stem.0.weight"]
        tensors["surplus"] = torch.zeros(1)
        tensors["decoder.out.bias"] = torch.zeros(7)

    rewrite(saved, change)
    refuses(
        saved,
        "missing encoder.stem.0.weight",
        "unexpected surplus",
        "decoder.out.bias is (7,), expected (4,)",
    )


def test_another_architecture_is_refused_with_a_short_list(saved):
    options = {"kind": "vonet", "width": 0.125, "decoders": 1, "head_stride": 1}
    rewrite(saved, metadata={"options": json.dumps({**options, "uncertainty": True})})
    refuses(saved, "head_rotation", "more")
    with pytest.raises(CheckpointError) as caught:
        load_weights(saved)
    assert len(str(caught.value)) < 1500


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite(saved, value):
    def change(tensors):
        tensors["encoder.layer3.2.conv1.weight"][0, 0, 0, 0] = value

    rewrite(saved, change)
    refuses(saved, "not finite", "encoder.layer3.2.conv1.weight")


@pytest.mark.parametrize("dtype", [torch.float64, torch.int32, torch.bool])
def test_foreign_types(saved, dtype):
    def change(tensors):
        tensors["decoder.out.bias"] = tensors["decoder.out.bias"].to(dtype)

    rewrite(saved, change)
    refuses(saved, "decoder.out.bias", "stored as")


@pytest.mark.parametrize(
    "options",
    [
        None,
        "",
        "not json",
        "[1]",
        "null",
        "{}",
        "[" * 100_000,
        '{"kind": "pwvo"}',
        '{"kind": "pwvo", "width": 1e9, "decoders": 1, "head_stride": 1, "uncertainty": true}',
        '{"kind": [], "width": 1, "decoders": 1, "head_stride": 1, "uncertainty": true}',
        '{"kind": "pwvo", "width": NaN, "decoders": 1, "head_stride": 1, "uncertainty": true}',
        '{"kind": "pwvo", "width": 1, "decoders": {}, "head_stride": 1, "uncertainty": true}',
    ],
)
def test_damaged_options(saved, options):
    rewrite(saved, metadata={"options": options})
    refuses(saved)


@pytest.mark.parametrize("card", [None, "[]", "card"])
def test_damaged_card(saved, card):
    rewrite(saved, metadata={"card": card})
    refuses(saved, "card")


def test_options_younger_than_the_file_have_their_default(saved):
    options = {"kind": "pwvo", "width": 0.125, "uncertainty": True}
    rewrite(saved, metadata={"options": json.dumps(options)})
    assert load_weights(saved)[0].options == OPTIONS
    rewrite(saved, metadata={"options": json.dumps({**options, "depth": 3})})
    refuses(saved, "unknown network options ['depth']")


def test_pretrained_names_what_is_known(tmp_path, monkeypatch, network):
    monkeypatch.setattr(weights, "SHIPPED", tmp_path)
    with pytest.raises(CheckpointError, match="No weights are shipped"):
        pretrained("pwvo")
    path = save_weights(tmp_path / "pwvo-wide.safetensors", network, OPTIONS, CARD)
    assert pretrained("pwvo-wide") == path
    with pytest.raises(CheckpointError, match="Did you mean 'pwvo-wide'"):
        pretrained("pwvo-wid")
    for name in ("../pwvo-wide", "", str(path)):
        with pytest.raises(CheckpointError, match="Shipped weights: pwvo-wide"):
            pretrained(name)


def test_shipped_weights_load_and_are_small():
    total = 0
    for name in weights.pretrained_names():
        path = pretrained(name)
        load_weights(path)
        total += path.stat().st_size
    assert total < 40e6
