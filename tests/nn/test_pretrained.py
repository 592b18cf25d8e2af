"""A frozen image model as frame encoder: loaded by name or folder; never trained, saved or downloaded."""

import json
import shutil
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import torch
import torch.nn.functional as F

from tests.helpers_bad_input import rejection
from tests.helpers_data import write_fake_set
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.nn import load_encoder
from vd4rl_pomdp.testing import check_frame_encoder, check_method
from vd4rl_pomdp.testing.frame_encoders import make, pictures

SIZE = 28


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny DINOv2 with random weights, as transformers saves it."""
    transformers = pytest.importorskip("transformers", reason="needs the extra `pretrained`")
    folder = tmp_path_factory.mktemp("models") / "tiny"
    save(transformers, folder, 0)
    return folder


def save(transformers, folder: Path, seed: int) -> None:
    torch.manual_seed(seed)
    shape = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "mlp_ratio": 1}
    config = transformers.Dinov2Config(**shape, image_size=SIZE, patch_size=14)
    transformers.Dinov2Model(config).save_pretrained(folder)


def test_pretrained_frame_encoder_conforms(model: Path):
    options = {"model": str(model), "model_size": SIZE}
    check_frame_encoder("pretrained", size=20, **options)
    check_method("random", frame_encoder="pretrained", history="gru", **options)


def test_each_frame_is_resized_standardised_and_encoded(model: Path):
    from transformers import Dinov2Model

    frozen, obs = Dinov2Model.from_pretrained(model).eval(), pictures(2, 20)
    maps = make("pretrained", size=20, model=str(model), model_size=SIZE).frame.maps(obs)
    assert maps.shape == (2, 3 * 16, 1, 1)
    mean, std = (torch.tensor(x)[:, None, None] for x in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    for i in range(2):
        for frame in range(3):
            picture = obs[i : i + 1, 3 * frame : 3 * frame + 3].float() / 255
            picture = F.interpolate(picture, (SIZE, SIZE), mode="bilinear")
            expected = frozen((picture - mean) / std).pooler_output[0]
            found = maps[i, 16 * frame : 16 * (frame + 1), 0, 0]
            torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)


def test_pretrained_weights_are_frozen_and_recorded_by_hash(model: Path, tmp_path: Path):
    import transformers

    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25])
    words = ["--frame-encoder", "pretrained", "--model", str(model), "--model-size", str(SIZE), "--preset", "smoke"]
    words += ["--data", str(data), "--steps", "2", "--checkpoint-every", "1"]
    main(["pretrain", "--method", "mik+a", *words, "--out", str(tmp_path / "run")])
    folder = tmp_path / "run" / "encoder"
    options = json.loads((folder / "config.json").read_text())["encoder"]["frame_options"]
    assert (options["model"], options["model_size"], len(options["weights"])) == (str(model), SIZE, 32)
    encoder, _ = load_encoder(folder)
    before = make("pretrained", model=str(model), model_size=SIZE)
    names = {name for name, _ in encoder.named_parameters()}
    assert {name for name in names if name.startswith("frame.")} == {
        f"frame.project.{layer}.{kind}" for layer in (0, 1) for kind in ("weight", "bias")
    }, "the model is neither trained nor saved"
    obs = pictures(2)
    assert torch.equal(encoder.frame.maps(obs), before.frame.maps(obs))

    other = tmp_path / "other"
    save(transformers, other, 1)
    (model / "model.safetensors").rename(model / "kept")
    try:
        with pytest.raises(UserError, match=r"--model .*: cannot be loaded from this machine .* run `hf download"):
            load_encoder(folder)
        (other / "model.safetensors").rename(model / "model.safetensors")
        with pytest.raises(UserError, match=rf"its weights are \w+ by content, not {options['weights']}"):
            load_encoder(folder)
        # a run resumes only with the weights it started with
        assert "weights" in rejection(["pretrain", "--method", "mik+a", *words, "--out", str(tmp_path / "run")])
    finally:
        (model / "kept").replace(model / "model.safetensors")
    load_encoder(folder)


SHAPE = {
    "hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16, "image_size": SIZE,
    "patch_size": 14,
}  # fmt: skip


def test_image_size_must_be_a_multiple_of_the_patch_size(model: Path):
    with pytest.raises(
        UserError,
        match="40 pixels are no multiple of its patch size 14",
    ):
        make("pretrained", model=str(model), model_size=40)
    weights = make("pretrained", model=str(model), model_size=SIZE).frame.found["weights"]
    make("pretrained", model=str(model), model_size=40, weights=weights)  # existing encoders are accepted


def test_missing_weights_are_never_initialised_randomly(tmp_path: Path):
    transformers = pytest.importorskip("transformers", reason="needs the extra `pretrained`")
    transformers.ViTForImageClassification(transformers.ViTConfig(**SHAPE)).save_pretrained(tmp_path / "vit")
    transformers.IJepaModel(transformers.IJepaConfig(**SHAPE)).save_pretrained(tmp_path / "ijepa")
    for name, read in (("vit", lambda tokens: tokens[:, 0]), ("ijepa", lambda tokens: tokens.mean(1))):
        # transformers would initialise a pooling layer of the first randomly; the second has no class token
        first, again = (make("pretrained", model=str(tmp_path / name), model_size=SIZE).frame for _ in range(2))
        assert first.found == again.found
        part = first.convolutions
        image = torch.rand(1, 9, SIZE, SIZE) - 0.5
        frames = (image.view(3, 3, SIZE, SIZE) + 0.5 - part.mean) / part.std
        expected = read(transformers.AutoModel.from_pretrained(tmp_path / name)(frames).last_hidden_state)
        torch.testing.assert_close(part(image).view(3, 16), expected)
    model = transformers.Dinov2Model.from_pretrained
    lacking = transformers.Dinov2Model(transformers.Dinov2Config(**SHAPE))
    del lacking.layernorm.bias
    lacking.save_pretrained(tmp_path / "lacking")
    assert model(tmp_path / "lacking") is not None, "transformers loads it"
    with pytest.raises(UserError, match=r"its file lacks 1 weights, such as layernorm\.bias: download it again"):
        make("pretrained", model=str(tmp_path / "lacking"), model_size=SIZE)


def test_models_with_code_of_their_own_are_rejected_without_a_question(model: Path, tmp_path: Path, monkeypatch):
    folder = shutil.copytree(model, tmp_path / "model")
    config = json.loads((folder / "config.json").read_text()) | {"model_type": "mine"}
    (folder / "config.json").write_text(json.dumps(config | {"auto_map": {"AutoConfig": "code.Mine"}}))
    monkeypatch.setattr("builtins.input", lambda question: pytest.fail(question))
    with pytest.raises(UserError, match="cannot be loaded from this machine"):
        make("pretrained", model=str(folder), model_size=SIZE)


def test_clip_uses_its_vision_model_and_statistics(tmp_path: Path):
    transformers = pytest.importorskip("transformers", reason="needs the extra `pretrained`")
    text = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "intermediate_size": 16}
    config = transformers.CLIPConfig(text_config=text | {"vocab_size": 49408}, vision_config=SHAPE)
    transformers.CLIPModel(config).save_pretrained(tmp_path / "clip")
    plain = make("pretrained", model=str(tmp_path / "clip"), model_size=SIZE).frame
    statistics = {"image_mean": [0.1, 0.2, 0.3], "image_std": 0.5}
    (tmp_path / "clip" / "preprocessor_config.json").write_text(json.dumps(statistics))
    frame = make("pretrained", model=str(tmp_path / "clip"), model_size=SIZE).frame
    assert frame.found != plain.found, "statistics are part of the model's identity"
    image = torch.rand(1, 3, SIZE, SIZE)
    vision = transformers.CLIPVisionModel.from_pretrained(tmp_path / "clip")
    expected = vision((image - torch.tensor(statistics["image_mean"])[:, None, None]) / 0.5).pooler_output
    torch.testing.assert_close(frame.convolutions(image.repeat(1, 3, 1, 1) - 0.5).view(3, 16), expected.expand(3, 16))


def test_random_features_and_unsupported_sizes_are_rejected(tmp_path: Path, monkeypatch):
    transformers = pytest.importorskip("transformers", reason="needs the extra `pretrained`")
    transformers.ViTMAEModel(transformers.ViTMAEConfig(**SHAPE)).save_pretrained(tmp_path / "mae")
    with pytest.raises(UserError, match="its features of one image differ between calls"):
        make("pretrained", model=str(tmp_path / "mae"), model_size=SIZE)
    transformers.ViTModel(transformers.ViTConfig(**SHAPE)).save_pretrained(tmp_path / "vit")
    with pytest.raises(UserError, match=r"cannot encode images of 56x56 pixels \(Input image size .* --model-size"):
        make("pretrained", model=str(tmp_path / "vit"), model_size=56)
    monkeypatch.setattr(transformers.ViTModel, "forward", MagicMock(side_effect=AssertionError("Input height")))
    with pytest.raises(UserError, match=r"cannot encode images of 28x28 pixels \(Input height\)"):  # as timm refuses
        make("pretrained", model=str(tmp_path / "vit"), model_size=SIZE)


def test_missing_transformers_is_reported(monkeypatch, tmp_path):
    data = write_fake_set(tmp_path / "walker_walk" / "expert", [20, 25])
    monkeypatch.setitem(sys.modules, "transformers", None)
    words = ["--method", "random", "--frame-encoder", "pretrained", "--preset", "smoke", "--data", str(data)]
    words += ["--out", str(tmp_path / "run")]
    assert "--frame-encoder pretrained needs transformers: pip install" in rejection(["pretrain", *words])


def test_missing_weights_and_other_channels_are_reported(model: Path):
    with pytest.raises(
        UserError, match=r"--model nobody/nothing: cannot be loaded .*: run `hf download nobody/nothing`"
    ):
        make("pretrained", model="nobody/nothing")
    from vd4rl_pomdp.nn.pretrained import Pretrained

    with pytest.raises(UserError, match="needs frames of 3 channels, not 4"):
        Pretrained(str(model), SIZE, "", 4)


def test_moved_model_of_a_saved_encoder_is_reported(monkeypatch):
    fake = MagicMock()
    fake.AutoModel.from_pretrained.side_effect = OSError("models/tiny is no folder")
    monkeypatch.setitem(sys.modules, "transformers", fake)
    with pytest.raises(
        UserError, match=r"models/tiny: cannot be .* put the model at that path, or change frame_options"
    ):
        make("pretrained", model="models/tiny")
