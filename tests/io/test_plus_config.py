"""PLUS configurations: every attribute, the old names, and files that mean harm."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sonosweep.errors import FormatError
from sonosweep.io.plus_config import HoleFillingStep, read_plus_config

from .damage import assert_reads_or_explains, damaged

TRANSFORM = (
    '<CoordinateDefinitions><Transform From="Image" To="Probe" Matrix="0.1 0 0 5  0 0.2 0 6'
    '  0 0 0.15 7  0 0 0 1" Error="1" Date="x"/></CoordinateDefinitions>'
)


def write_config(folder, attributes='OutputSpacing="0.5 0.5 0.5"', inside="", transform=TRANSFORM):
    """Write a configuration with these attributes of its VolumeReconstruction element."""
    path = folder / "device.xml"
    path.write_text(
        f'<PlusConfiguration version="2.1">{transform}'
        f"<VolumeReconstruction {attributes}>{inside}</VolumeReconstruction></PlusConfiguration>"
    )
    return path


def settings_of(folder, attributes, inside=""):
    """Return the settings that these attributes make."""
    path = write_config(folder, f'OutputSpacing="0.5 0.5 0.5" {attributes}', inside)
    settings = read_plus_config(path).reconstruction
    assert settings is not None
    return settings


def test_the_real_configurations_say_what_plus_did(recordings):
    """The four ways in which PLUS made its reference volumes."""
    folder = recordings / "plus_spine_freehand"
    read = {path.name[:-4]: read_plus_config(path) for path in folder.glob("*.xml")}
    settings = {name.rsplit("_", 2)[-1]: c.reconstruction for name, c in read.items()}

    assert len(read) == 4
    assert all(config.ignored == () for config in read.values())
    assert all(
        set(c.transforms) == {("Image", "Probe"), ("Phantom", "Reference")} for c in read.values()
    )
    late = settings["LATE"]
    assert (late.interpolation, late.compounding, late.fill_holes) == ("nearest", "latest", False)
    assert (late.clip_origin_px, late.clip_size_px) == ((192, 16), (420, 580))
    assert (late.fan_angles_deg, late.fan_origin_px) == ((-45, 45), (380, 20))
    assert late.fan_radius_px == (120, 360)
    assert settings["MEAN"].hole_filling == (HoleFillingStep("STICK"),)
    assert (settings["MAXI"].interpolation, settings["MAXI"].compounding) == ("linear", "maximum")


def test_the_old_names_of_plus_2_3_are_understood(recordings):
    """Compounding="On" is the mean."""
    config = read_plus_config(recordings / "plus_bone_l14" / "BoneUltrasound_L14_config.xml")

    assert config.reconstruction is not None
    assert config.reconstruction.compounding == "mean"
    assert config.calibration is not None
    assert config.calibration.spacing_mm == pytest.approx((0.0854354, 0.0854351), abs=1e-6)


def test_every_attribute_is_read(tmp_path):
    """What PLUS documents has a field of ours."""
    settings = settings_of(
        tmp_path,
        'ImageCoordinateFrame="Picture" ReferenceCoordinateFrame="Table" OutputOrigin="1 2 3"'
        ' OutputExtent="0 9 0 19 0 29" ClipRectangleOrigin="4 5" ClipRectangleSize="60 70"'
        ' FanAnglesDeg="-30 40" FanOriginPixel="320 -20.5" FanRadiusStartPixel="50"'
        ' FanRadiusStopPixel="400" EnableFanAnglesAutoDetect="TRUE"'
        ' FanAnglesAutoDetectBrightnessThreshold="25" FanAnglesAutoDetectFilterRadiusPixel="7"'
        ' PixelRejectionThreshold="3" SkipInterval="2" Interpolation="LINEAR"'
        ' CompoundingMode="IMPORTANCE_MASK" ImportanceMaskFilename="mask.png" FillHoles="ON"'
        ' NumberOfThreads="2"',
        '<HoleFilling><HoleFillingElement Type="GAUSSIAN" Size="5" Stdev="0.7"'
        ' MinimumKnownVoxelsRatio="0.3"/><HoleFillingElement Type="STICK" StickLengthLimit="12"'
        ' NumberOfSticksToUse="3"/></HoleFilling>',
    )

    assert (settings.image_system, settings.reference_system) == ("Picture", "Table")
    assert settings.output_origin_mm == (1, 2, 3)
    assert settings.output_extent == (0, 9, 0, 19, 0, 29)
    assert (settings.clip_origin_px, settings.clip_size_px) == ((4, 5), (60, 70))
    assert (settings.fan_angles_deg, settings.fan_origin_px) == ((-30, 40), (320, -20.5))
    assert settings.fan_radius_px == (50, 400)
    assert settings.detect_fan_angles
    assert (settings.fan_brightness_threshold, settings.fan_filter_radius_px) == (25, 7)
    assert (settings.pixel_rejection_threshold, settings.skip_interval) == (3, 2)
    assert (settings.interpolation, settings.compounding) == ("linear", "importance_mask")
    assert (settings.importance_mask, settings.number_of_threads) == ("mask.png", 2)
    assert settings.hole_filling == (
        HoleFillingStep("GAUSSIAN", 5, 0.7, 0.3),
        HoleFillingStep("STICK", stick_length_limit=12, sticks=3),
    )


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ('Compounding="Off"', "latest"),
        ('Compounding="ON" Calculation="WEIGHTED_AVERAGE"', "mean"),
        ('Compounding="ON" Calculation="MAXIMUM"', "maximum"),
        ('Compounding="ON" CompoundingMode="LATEST"', "latest"),
        ("", "mean"),
    ],
)
def test_the_newest_word_for_compounding_wins(tmp_path, attributes, expected):
    """Old files say it in two attributes, and some carry old and new words."""
    assert settings_of(tmp_path, attributes).compounding == expected


def test_old_fan_names_are_the_new_ones(tmp_path):
    """FanAngles, FanOrigin and FanDepth were renamed, not redefined."""
    old = settings_of(tmp_path, 'FanAngles="-30 40" FanOrigin="320 20" FanDepth="400"')
    new = settings_of(
        tmp_path, 'FanAnglesDeg="-30 40" FanOriginPixel="320 20" FanRadiusStopPixel="400"'
    )

    assert old == new


def test_zeros_mean_not_used(tmp_path):
    """PLUS writes 0 0 for no clipping and no fan."""
    settings = settings_of(tmp_path, 'ClipRectangleSize="0 0" FanAnglesDeg="0 0"')

    assert settings.clip_size_px is None
    assert settings.fan_angles_deg is None


def test_what_has_no_effect_is_remembered(tmp_path):
    """Speed options are dropped; a name that nobody knows is told."""
    path = write_config(tmp_path, 'OutputSpacing="1 1 1" Optimization="FULL" Colour="blue"', "<X/>")

    assert read_plus_config(path).ignored == ("Colour", "<X>")


def test_a_calibration_without_reconstruction_is_enough(tmp_path):
    """Most device sets have no VolumeReconstruction."""
    path = tmp_path / "device.xml"
    path.write_text(f"<PlusConfiguration>{TRANSFORM}</PlusConfiguration>")

    config = read_plus_config(path)

    assert config.reconstruction is None
    expected = torch.tensor([0.1, 0, 0, 5], dtype=torch.float64)
    assert torch.equal(config.transforms[("Image", "Probe")][0], expected)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ("", "no OutputSpacing"),
        ('OutputSpacing="0.5 0.5"', "OutputSpacing='0.5 0.5'"),
        ('OutputSpacing="0.5 0.5 0"', "above 0 mm"),
        ('OutputSpacing="0.5 0.5 nan"', "makes no sense"),
        ('OutputSpacing="1 1 1" Interpolation="CUBIC"', "Interpolation='CUBIC'"),
        ('OutputSpacing="1 1 1" ClipRectangleSize="-5 3"', "above 0 pixels"),
        ('OutputSpacing="1 1 1" ClipRectangleSize="5.5 3"', "makes no sense"),
        ('OutputSpacing="1 1 1" FanAnglesDeg="40 -40"', "rise from left to right"),
        ('OutputSpacing="1 1 1" FanRadiusStartPixel="600"', "stops at 500"),
        ('OutputSpacing="1 1 1" OutputExtent="0 9 5 4 0 9"', "ends before it starts"),
        ('OutputSpacing="1 1 1" FillHoles="ON"', "no HoleFillingElement"),
        ('OutputSpacing="1 1 1" FillHoles="PERHAPS"', "FillHoles='PERHAPS'"),
    ],
)
def test_a_value_that_cannot_be_is_named(tmp_path, attributes, message):
    """The sentence holds the attribute and its value."""
    with pytest.raises(FormatError, match=message):
        read_plus_config(write_config(tmp_path, attributes))


@pytest.mark.parametrize(
    "matrix", ["1 2 3", "nan " * 16, "1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1", "0 " * 15 + "1"]
)
def test_a_matrix_that_is_none_is_named(tmp_path, matrix):
    """A transform must have 16 numbers, an affine last row and an inverse."""
    transform = (
        '<CoordinateDefinitions><Transform From="Image" To="Probe" Matrix="'
        f'{matrix}"/></CoordinateDefinitions>'
    )

    with pytest.raises(FormatError, match="matrix of ImageToProbe"):
        read_plus_config(write_config(tmp_path, transform=transform))


@pytest.mark.parametrize(
    "declaration",
    [
        "<!DOCTYPE a ["
        + "".join(f'<!ENTITY e{k + 1} "{f"&e{k};" * 10}">' for k in range(9))
        + '<!ENTITY e0 "ha">]>',
        '<!DOCTYPE a SYSTEM "file:///etc/passwd">',
        '<!DOCTYPE a [<!ENTITY e SYSTEM "file:///dev/zero">]>',
    ],
    ids=["billion laughs", "external subset", "external entity"],
)
def test_entities_are_refused_before_they_grow(tmp_path, declaration):
    """A document type is all that an XML bomb needs, and PLUS never writes one."""
    path = tmp_path / "device.xml"
    path.write_text(f'<?xml version="1.0"?>{declaration}<a>&e9;</a>')

    with pytest.raises(FormatError, match="declares a document type"):
        read_plus_config(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "is no XML"),
        (b"<a>", "is no XML"),
        (b"<a/>", "is no PLUS configuration"),
        (b"\xff\xfe<\x00a", "is no XML"),
        (b"<?xml version='1.0' encoding='klingon'?><a/>", "is no XML"),
        (b"<a>" * 100_000, "is no XML"),
        (b"<a>" + b" " * (17 << 20), "larger than any"),
    ],
    ids=["empty", "cut off", "other", "half utf-16", "encoding", "deep", "large"],
)
def test_what_is_no_configuration_is_said_so(tmp_path, text, message):
    """Neither broken nor foreign XML gives more than a sentence."""
    path = tmp_path / "device.xml"
    path.write_bytes(text)

    with pytest.raises(FormatError, match=message):
        read_plus_config(path)


@given(data=st.data())
def test_damaged_configurations_are_read_or_explained(tmp_path_factory, data):
    """No damage gives anything but settings or one sentence."""
    folder = tmp_path_factory.mktemp("damage")
    path = write_config(folder, 'OutputSpacing="1 1 1" FanAnglesDeg="-4 4" SkipInterval="2"')
    path.write_bytes(data.draw(damaged(path.read_bytes())))

    assert_reads_or_explains(lambda: read_plus_config(path))
