"""Messages if a generator's packages or weights are missing; needs no diffusers."""

import errno

import pytest

from command import run
from gscompleter import InputError, load_generator
from gscompleter.apps.command_line.exit_codes import ERROR
from gscompleter.apps.command_line.failures import explain_failure
from gscompleter.config.generators import GeneratorOptions, get_settings_class
from gscompleter.models.diffusion import published
from gscompleter.models.diffusion.loading import find_sources
from gscompleter.models.diffusion.published import (
    KONTEXT,
    PE_FIELD,
    IncompleteWeightsError,
    Source,
    announce,
    convert_load_errors,
    create_load_error,
    parse_source,
)
from gscompleter.models.settings import PEFieldSettings
from scenes import camera_at, photographed


@pytest.mark.parametrize("name", ["pe-field", "diffusers-inpaint"])
def test_without_the_packages_one_sentence_says_what_to_install(name, monkeypatch):
    monkeypatch.setattr(published, "PACKAGES", ("a_package_nobody_has", "torch"))
    with pytest.raises(InputError) as caught:
        load_generator(name, settings=get_settings_class(name)(weights="somebody/something"))
    message = str(caught.value)
    assert "a_package_nobody_has" in message
    assert "torch" not in message
    assert "pip install 'gscompleter[diffusion]'" in message


@pytest.mark.parametrize(
    ("name", "setting", "way_out"),
    [
        (
            "warp-inpaint",
            {"weights": "somebody/something"},
            "choose pe-field or diffusers-inpaint or",
        ),
        ("oracle", {"steps": 8}, "choose pe-field or diffusers-inpaint or"),
        ("pe-field", {"prompt": "a cat"}, "choose diffusers-inpaint"),
        ("diffusers-inpaint", {"depth": "monocular"}, "choose pe-field"),
    ],
)
def test_a_setting_that_a_generator_does_not_know_is_refused(name, setting, way_out):
    ((key, value),) = setting.items()
    with pytest.raises(InputError) as caught:
        GeneratorOptions(name, **{f"generator_{key}": value}).make_settings()
    assert f"{name!r} has no setting {key};" in str(caught.value)
    assert way_out in str(caught.value)
    assert caught.value.argument == f"generator_{key}"


def test_the_settings_of_another_generator_are_refused():
    with pytest.raises(InputError, match="'oracle' takes GeneratorSettings, got PEFieldSettings"):
        load_generator("oracle", settings=PEFieldSettings())


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("steps", 0, "steps must be greater than or equal to 1, got 0"),
        ("steps", 10**9, "steps must be less than or equal to 1000"),
        ("retries", -1, "retries must be greater than or equal to 0"),
        ("batch_size", 0, "batch_size must be greater than or equal to 1"),
        ("weights", "", "weights must have at least 1 character"),
        ("depth", "", "depth must have at least 1 character"),
        ("offload", True, "offload keeps parts .* and it runs on the CPU"),
    ],
)
def test_values_that_mean_nothing_are_refused(key, value, message):
    with pytest.raises(InputError, match=message) as caught:
        load_generator("pe-field", settings=PEFieldSettings(**{key: value}))
    assert caught.value.argument == f"generator_{key}"


def test_the_command_refuses_them_too_and_writes_nothing(tmp_path, capsys, monkeypatch):
    cameras = [camera_at(x, size=32) for x in (-0.3, 0.1, 0.6)]
    scene = photographed(tmp_path / "scene", cameras)
    words = ["complete", scene, "--context", 0, 1, "--target", 2, "--out", tmp_path / "out"]
    assert run(monkeypatch, *words, "--generator-batch-size", 8) == 2
    printed = capsys.readouterr().err
    assert "'warp-inpaint' has no setting batch_size; leave it out, or choose pe-field" in printed
    assert "(--generator-batch-size)." in printed
    assert not (tmp_path / "out").exists()


def test_an_inpainter_must_be_named(monkeypatch):
    monkeypatch.setattr(published, "PACKAGES", ())
    with pytest.raises(InputError, match="needs the path of a model"):
        load_generator("diffusers-inpaint")


def test_a_path_is_a_folder_or_an_id_with_or_without_its_commit(tmp_path):
    assert parse_source(str(tmp_path)) == Source(location=str(tmp_path))
    assert parse_source(str(tmp_path)).is_pinned
    loose = parse_source("somebody/something")
    assert (loose.location, loose.revision, loose.is_pinned) == (
        "somebody/something",
        "main",
        False,
    )
    commit = "0123456789abcdef" * 2 + "01234567"
    pinned = parse_source(f"somebody/something@{commit}")
    assert (pinned.revision, pinned.is_pinned) == (commit, True)
    assert parse_source("somebody/flux-fill").terms != loose.terms
    for wrong in ("nothing", "./a/b", "/a/b", "a/b/c", "a/", "~nobody_here/model"):
        with pytest.raises(InputError, match="no repository"):
            parse_source(wrong)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("black-forest-labs/FLUX.2-klein-4B", "Apache-2.0"),
        ("black-forest-labs/FLUX.2-klein-base-4B", "Apache-2.0"),
        ("black-forest-labs/FLUX.2-klein-9B", "the FLUX Non-Commercial License"),
        ("black-forest-labs/FLUX.1-schnell", "Apache-2.0"),
        ("black-forest-labs/FLUX.1-Fill-dev", "the FLUX.1 [dev] Non-Commercial License"),
        ("stable-diffusion-v1-5/stable-diffusion-inpainting", "CreativeML Open RAIL-M"),
        ("somebody/stable-diffusion-2-inpainting", "CreativeML Open RAIL++-M"),
        ("stabilityai/stable-diffusion-3.5-medium", "the Stability AI Community License"),
    ],
)
def test_members_of_a_family_with_licences_of_their_own_are_told_apart(name, words):
    assert f"(usually {words}" in parse_source(name).terms


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 GB"),
        OSError(errno.ENOSPC, "No space left on device"),
    ],
)
def test_a_full_machine_is_not_told_as_a_fault_of_the_weights(error, tmp_path):
    """Let a lack of memory (text encoders take 10 GB) and a full disk (a download) go on."""
    pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    with pytest.raises(type(error)) as caught, convert_load_errors(KONTEXT):
        try:
            raise error
        except (OSError, RuntimeError) as cause:
            # As the libraries do.
            raise type(error)("Can't load the model") from cause
    failure = explain_failure(caught.value)
    assert failure is not None
    assert failure.code == ERROR
    with pytest.raises(InputError), convert_load_errors(Source(location=str(tmp_path))):
        raise OSError("no config.json")


def test_gate_licence_and_missing_pin_are_named_before_a_download_and_a_folder_needs_no_word(
    capsys, tmp_path
):
    announce([Source(location=str(tmp_path))])
    assert capsys.readouterr().err == ""
    announce([KONTEXT, PE_FIELD])
    printed = capsys.readouterr().err
    assert "https://huggingface.co/black-forest-labs/FLUX.1-Kontext-dev" in printed
    assert "must be accepted on its page" in printed
    assert "https://huggingface.co/yunpeng1998/PE-Field" in printed
    assert printed.count("is not pinned") == 2
    assert printed.count("Non-Commercial") + printed.count("non-commercial") == 2


def test_what_is_read_twice_is_announced_once(capsys):
    base, transformer = find_sources("somebody/something@abc")
    announce([base, transformer])
    assert capsys.readouterr().err.count("somebody/something") == 1


def test_the_sentence_names_what_did_not_load_and_how_to_mend_it(tmp_path):
    def message_for(source: Source, error: Exception, setting: str = "weights") -> str:
        return str(create_load_error(source, error, setting))

    lost = IncompleteWeightsError("vae", ["a", "b", "c"])
    assert "its vae lacks the tensor a and 2 more" in message_for(PE_FIELD, lost)
    assert "accepted its terms" not in message_for(PE_FIELD, lost)
    assert "yunpeng1998/PE-Field" in message_for(PE_FIELD, lost)
    assert "accepted its terms at https://huggingface.co/black" in message_for(
        KONTEXT, OSError("gated")
    )
    depth = parse_source("somebody/depth", "transformers")
    assert "give a folder as its depth" in message_for(depth, OSError("?"), "depth")
    assert "see that it is complete" in message_for(
        parse_source(str(tmp_path)), OSError("no config.json")
    )
    with pytest.raises(InputError, match="a folder that transformers saved"):
        parse_source("nothing", "transformers")


def test_a_pipeline_brings_its_own_transformer_and_a_transformer_joins_the_published_base(tmp_path):
    assert find_sources(None) == (KONTEXT, PE_FIELD)
    whole, alone = tmp_path / "whole", tmp_path / "alone"
    for folder, file in ((whole, "model_index.json"), (alone, "config.json")):
        folder.mkdir()
        (folder / file).write_text("{}")
    base, transformer = find_sources(str(whole))
    assert (base.location, base.subfolder) == (str(whole), None)
    assert (transformer.location, transformer.subfolder) == (str(whole), "transformer")
    assert find_sources(str(alone)) == (KONTEXT, Source(location=str(alone)))
    base, transformer = find_sources("somebody/something@abc")
    assert base.load_arguments == {"revision": "abc"}
    assert transformer.load_arguments == {"revision": "abc", "subfolder": "transformer"}
