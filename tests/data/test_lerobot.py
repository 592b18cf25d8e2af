"""Export and import of LeRobot's format. `tools/lerobot_check.py` reads an export with LeRobot itself."""

import io
import json

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from tests.helpers_data import assert_equal_rows, fake_episode, fake_reward, rows_of_set, write_fake_set, write_rows
from vd4rl_pomdp.cli import main
from vd4rl_pomdp.core.errors import UserError
from vd4rl_pomdp.core.types import StepType
from vd4rl_pomdp.data import open_dataset
from vd4rl_pomdp.data.format import FRAMES_KEY
from vd4rl_pomdp.data.formats.lerobot import LEROBOT, _encode
from vd4rl_pomdp.data.transfer import export_set, import_set

arrow = pytest.importorskip("pyarrow")
pytest.importorskip("av")
pq = pytest.importorskip("pyarrow.parquet")
LENGTHS = [20, 25, 9]
PICTURE = "observation.image"
DATA, INDEX = (f"{part}/chunk-000/file-000.parquet" for part in ("data", "meta/episodes"))


@pytest.fixture
def exported(tmp_path):
    """A set with noise images in LeRobot's format, and its source."""
    own = write_fake_set(tmp_path / "own", LENGTHS, noise=84, attributes={"task": "walker_walk", "set": "mine"})
    export_set("lerobot", own, tmp_path / "out")
    return tmp_path / "out", own


def rewrite(folder, change, name=DATA):
    """Apply `change` to a parquet table of a set."""
    pq.write_table(change(pq.read_table(folder / name)), folder / name, row_group_size=7)


def edit_info(folder, change):
    """Apply `change` to info.json."""
    info = json.loads((folder / "meta" / "info.json").read_text())
    change(info)
    (folder / "meta" / "info.json").write_text(json.dumps(info))


def png(pixels):
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def showing(content):
    """Replace all images by a file's content."""

    def change(table):
        images = arrow.array([{"bytes": content, "path": None}] * len(table), table.schema.field(PICTURE).type)
        return table.set_column(table.schema.get_field_index(PICTURE), PICTURE, images)

    return change


def as_others_write(folder, scale=1.0, discount=False):
    """Make it a set of another writer: one row per action, actions scaled, no final image, and no discounts or own
    ones."""

    def without_last(table):
        numbers = table["episode_index"].to_numpy()
        table = table.filter(arrow.array(np.diff(numbers, append=-1) == 0))
        table = table if discount else table.drop(["next.discount"])
        done = np.diff(table["episode_index"].to_numpy(), append=-1) != 0
        action = arrow.array(list(np.array(table["action"].to_pylist(), np.float32) * np.float32(scale)))
        table = table.set_column(table.schema.get_field_index("action"), "action", action)
        return table.set_column(table.schema.get_field_index("next.done"), "next.done", arrow.array(done))

    rewrite(folder, without_last)
    shorter = arrow.array([length - 1 for length in LENGTHS])
    rewrite(folder, lambda t: t.set_column(t.schema.get_field_index("length"), "length", shorter), INDEX)
    column = "info" if discount else "next.discount"
    edit_info(folder, lambda i: (i["features"]["next.discount"] if discount else i["features"]).pop(column))
    edit_info(folder, lambda info: info.update(total_frames=sum(LENGTHS) - 3))


def test_lerobot_image_round_trip_is_lossless(tmp_path, capsys):
    attributes = {"task": "walker_walk", "set": "mine"}
    own = write_fake_set(tmp_path / "own", LENGTHS, 1, complete_last=False, physics_dim=2, attributes=attributes)
    main(["data", "export", "lerobot", str(own), str(tmp_path / "out")])
    assert "20 a second" in capsys.readouterr().err
    (tmp_path / "out" / INDEX).with_name("._file-000.parquet").write_bytes(b"\0\5\x16\7")  # as macOS writes it
    main(["data", "import", "lerobot", str(tmp_path / "out"), str(tmp_path / "back")])
    assert "pretraining's default window" in (stderr := capsys.readouterr().err)
    assert stderr.count("note:") == 1
    assert_equal_rows(rows_of_set(own), rows_of_set(tmp_path / "back"))
    dataset = open_dataset(tmp_path / "back", tmp_path / "cache")
    assert (dataset.task, dataset.quality, dataset.incomplete_episodes) == ("walker_walk", "mine", 1)


def test_exported_rows_follow_lerobot_format(exported):
    rows = pq.read_table(exported[0] / DATA).slice(LENGTHS[0], LENGTHS[1]).to_pydict()
    action = fake_episode(1, 25)["action"]
    np.testing.assert_array_equal(rows["action"], [*action[1:], action[-1]])  # a_t beside o_t, the last one twice
    assert rows["next.reward"] == [*(fake_reward(1, t) for t in range(24)), 0]
    assert rows["next.done"] == [False] * 23 + [True] * 2
    np.testing.assert_array_equal(rows["timestamp"], (np.arange(25) / 20).astype(np.float32))
    assert rows["index"] == list(range(20, 45))
    episodes = pq.read_table(exported[0] / INDEX).to_pydict()
    assert (episodes["dataset_from_index"], episodes["dataset_to_index"]) == ([0, 20, 45], [20, 45, 54])
    assert [row["tasks"] for row in pq.read_table(exported[0] / INDEX).to_pylist()] == [["walker_walk"]] * 3
    stats = json.loads((exported[0] / "meta" / "stats.json").read_text())
    whole = np.array(pq.read_table(exported[0] / DATA)["action"].to_pylist())
    np.testing.assert_allclose(stats["action"]["std"], whole.std(0), rtol=1e-6)
    assert (np.shape(stats["observation.image"]["mean"]), stats["action"]["count"]) == ((3, 1, 1), [54])


def test_lerobot_video_changes_only_images(tmp_path, capsys):
    rows = fake_episode(0, 25)
    grey = np.arange(25, dtype=np.uint8) * 10
    rows[FRAMES_KEY] = np.broadcast_to(grey[:, None, None, None], (25, 3, 84, 84))
    own = write_rows(tmp_path / "own", rows, {"task": "walker_walk", "set": "mine"})
    export_set("lerobot_video", own, tmp_path / "out")
    assert "values are off by" in capsys.readouterr().err
    import_set("lerobot", str(tmp_path / "out"), tmp_path / "back")
    back = rows_of_set(tmp_path / "back")
    assert_equal_rows(rows_of_set(own), back, but=[FRAMES_KEY])
    assert np.abs(back[FRAMES_KEY].astype(int) - rows[FRAMES_KEY]).max() <= 2
    # LeRobot puts many episodes into one video: this episode now begins at 0.4 seconds
    film = tmp_path / "out" / "videos" / "observation.image" / "chunk-000" / "file-000.mp4"
    _encode(film, np.concatenate([rows[FRAMES_KEY][:8], rows[FRAMES_KEY]]).transpose(0, 2, 3, 1))
    column = "videos/observation.image/from_timestamp"
    later = arrow.array([0.4])
    rewrite(tmp_path / "out", lambda t: t.set_column(t.schema.get_field_index(column), column, later), INDEX)
    again = next(LEROBOT.read(str(tmp_path / "out"), None).read(0))[FRAMES_KEY]
    assert np.abs(again.astype(int) - rows[FRAMES_KEY]).max() <= 2
    whole = film.read_bytes()
    film.write_bytes(whole[:300])
    with pytest.raises(UserError, match=r"out: episode 0: file-000.mp4 is damaged"):
        import_set("lerobot", str(tmp_path / "out"), tmp_path / "damaged")
    film.with_name("other.mp4").write_bytes(whole)
    film.write_text("ffconcat version 1.0\nfile other.mp4\n")
    with pytest.raises(UserError, match=r"out: episode 0: file-000.mp4 is damaged or not a video"):
        import_set("lerobot", str(tmp_path / "out"), tmp_path / "playlist")


@pytest.mark.parametrize("discount", [False, True])
def test_lerobot_set_without_final_images_drops_last_step(exported, tmp_path, capsys, discount):
    out, own = exported
    as_others_write(out, 100, discount)
    import_set("lerobot", str(out), tmp_path / "back")
    stderr = capsys.readouterr().err
    assert "rewards (3.048 in all) of 3 episodes have no following image" in stderr
    assert "each dimension's minimum and maximum become -1 and 1" in stderr
    rows, given = rows_of_set(tmp_path / "back"), rows_of_set(own)
    kept = np.concatenate([np.arange(19), 20 + np.arange(24), 45 + np.arange(8)])
    np.testing.assert_array_equal(rows[FRAMES_KEY], given[FRAMES_KEY][kept])
    np.testing.assert_array_equal(rows["reward"], given["reward"][kept])
    assert (rows["step_type"][[18, 42, 50]] == StepType.LAST).all()
    assert (rows["discount"] == 1).all()
    action, theirs = rows["action"][rows["step_type"] != 0], given["action"][kept][rows["step_type"] != 0]
    slope, _ = np.polyfit(theirs[:, 0], action[:, 0], 1)
    np.testing.assert_allclose(action[:, 0] - slope * theirs[:, 0], (action - slope * theirs)[0, 0], atol=1e-4)


def test_lerobot_set_without_task_gets_its_folders_name(tmp_path):
    export_set("lerobot", write_fake_set(tmp_path / "own", LENGTHS), tmp_path / "pushing")
    import_set("lerobot", str(tmp_path / "pushing"), tmp_path / "back")
    assert open_dataset(tmp_path / "back", tmp_path / "cache").task == "pushing"


def test_lerobot_sets_of_several_tasks_print_a_note(exported, tmp_path, capsys):
    tasks = pd.DataFrame({"task_index": range(4)}, index=pd.Index(["push", "open it", "c", "d"], name="task"))
    tasks.to_parquet(exported[0] / "meta" / "tasks.parquet")
    import_set("lerobot", str(exported[0]), tmp_path / "back")
    assert "its 4 tasks become one dataset: 'push', 'open it', 'c', ...\n" in capsys.readouterr().err


def test_reading_from_later_episode_gives_same_rows(exported):
    opened = LEROBOT.read(str(exported[0]), None)
    for first in range(3):
        for late, whole in zip(opened.read(first), list(opened.read(0))[first:], strict=True):
            assert_equal_rows(late, whole)


def test_lerobot_camera_is_selected_by_picture_option(exported, tmp_path):
    def second(table):
        return table.append_column("observation.images.top", table["observation.image"].take(list(range(53, -1, -1))))

    rewrite(exported[0], second)
    edit_info(
        exported[0], lambda i: i["features"].update({"observation.images.top": i["features"]["observation.image"]})
    )
    with pytest.raises(UserError, match=r"choose one with --picture, of observation.image, observation.images.top"):
        import_set("lerobot", str(exported[0]), tmp_path / "back")
    import_set("lerobot", str(exported[0]), tmp_path / "back", picture="observation.images.top")
    frames = rows_of_set(exported[1])[FRAMES_KEY]
    np.testing.assert_array_equal(rows_of_set(tmp_path / "back")[FRAMES_KEY], frames[::-1])


def info(change):
    """Damage by a change to info.json."""
    return lambda folder: edit_info(folder, change)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda out: (out / "meta" / "info.json").unlink(), "not a local LeRobot dataset"),
        (lambda out: (out / DATA).unlink(), "No such file"),
        (lambda out: (out / DATA).write_bytes((out / DATA).read_bytes()[:5000]), "cannot be read as this format"),
        (lambda out: rewrite(out, lambda table: table.slice(0, 30)), "lacks rows"),
        (
            lambda out: rewrite(out, showing(png(np.full((84, 84), 600, np.uint16)))),
            "more than 8 bits per channel .*: convert it to 8 bits",
        ),
        (info(lambda info: info.update(codebase_version="v2.1")), "convert_dataset_v21_to_v30"),
        (info(lambda info: info.update(total_episodes=4)), "has 3 of 4 episodes"),
        (info(lambda info: info.update(total_frames=50)), "has 54 of 50 frames"),
        (info(lambda info: info.pop("features")), r"info.json: its features is missing or damaged"),
        (info(lambda info: info.update(fps="20")), r"info.json: its fps is missing or damaged"),
        (info(lambda info: info["features"].update(action=[])), "its action is missing or damaged"),
        (info(lambda info: info["features"][PICTURE].update(shape=[64, 64, 3])), "84x84 pixels, .* 64x64"),
        (info(lambda info: info.update(data_path="data/{0}")), "cannot be read as this format"),
        (info(lambda info: info["features"].pop(PICTURE)), "holds no images"),
        (info(lambda i: i["features"].pop("action")), r"out: has no feature 'action' \(features: observation.image, "),
    ],
)
def test_damaged_lerobot_sets_are_rejected(exported, damage, message, tmp_path):
    damage(exported[0])
    with pytest.raises(UserError, match=message):
        import_set("lerobot", str(exported[0]), tmp_path / "back")
    assert not (tmp_path / "back").exists()


def test_images_are_decoded_only_in_known_formats_and_sizes(exported, tmp_path, monkeypatch):
    monkeypatch.setattr(Image.Image, "convert", None)  # what decodes: neither Ghostscript nor 300 MB may be reached
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 84 84\n%%EndComments\n%%EOF\n"
    for content, message in ((eps, "cannot identify image"), (png(np.zeros((9000, 9000), bool)), "9000x9000 pixels")):
        rewrite(exported[0], showing(content))
        with pytest.raises(UserError, match=message):
            import_set("lerobot", str(exported[0]), tmp_path / "back")


@pytest.mark.parametrize("path", ["{folder}/other.parquet", "../other.parquet", "data/../../other.parquet"])
def test_lerobot_files_outside_its_folder_are_not_read(exported, tmp_path, path):
    (exported[0] / DATA).rename(tmp_path / "other.parquet")
    edit_info(exported[0], lambda info: info.update(data_path=path.replace("{folder}", str(tmp_path))))
    with pytest.raises(UserError, match=r"names the file .*other.parquet, outside its folder"):
        import_set("lerobot", str(exported[0]), tmp_path / "back")


def test_lerobot_sets_in_the_hubs_cache_are_imported(exported, tmp_path):
    """Their files are links, snapshots/REVISION/data/... to ../../blobs/HASH."""
    blobs, snapshot = tmp_path / "cache" / "blobs", tmp_path / "cache" / "snapshots" / "f00"
    blobs.mkdir(parents=True)
    for number, file in enumerate(sorted(path for path in exported[0].rglob("*") if path.is_file())):
        link = snapshot / file.relative_to(exported[0])
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(file.rename(blobs / str(number)))
    import_set("lerobot", str(snapshot), tmp_path / "back")
    assert_equal_rows(rows_of_set(exported[1]), rows_of_set(tmp_path / "back"))


def test_lerobot_video_of_odd_size_is_rejected(exported, tmp_path):
    with pytest.raises(UserError, match="even height and width, not 63"):
        export_set("lerobot_video", exported[1], tmp_path / "film", size=63)
    assert not (tmp_path / "film").exists()
