"""A new DICOM header that names nobody: no patient, no date, no institution, new UIDs."""

import io

from pydicom import Dataset, FileMetaDataset, dcmwrite
from pydicom.uid import ExplicitVRLittleEndian, generate_uid

# Elements that the standard wants present and allows to be empty.
EMPTY = (
    "PatientName",
    "PatientID",
    "PatientBirthDate",
    "PatientSex",
    "StudyDate",
    "StudyTime",
    "StudyID",
    "AccessionNumber",
    "ReferringPhysicianName",
    "ContentDate",
    "ContentTime",
    "SeriesNumber",
    "Laterality",
    "PatientOrientation",
)
METHOD = "written anew by sonosweep: pixels and geometry only"


def new_dicom(sop_class: str, modality: str) -> Dataset:
    """Return a header with the elements that every image has, and nobody in it.

    Args:
        sop_class: UID of the kind of object.
        modality: Two letters, such as ``"US"``.
    """
    header = Dataset()
    for keyword in EMPTY:
        setattr(header, keyword, None)
    header.SOPClassUID = sop_class
    header.SOPInstanceUID = new_uid()
    header.StudyInstanceUID = new_uid()
    header.SeriesInstanceUID = new_uid()
    header.Modality = modality
    header.InstanceNumber = 1
    header.Manufacturer = "sonosweep"
    header.PatientIdentityRemoved = "YES"
    header.DeidentificationMethod = METHOD
    header.file_meta = FileMetaDataset()
    header.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    return header


def new_uid() -> str:
    """Return a UID made of a random number (2.25...), which says nothing about its origin."""
    return generate_uid(prefix=None)


def describe_pixels(header: Dataset, rows: int, columns: int, bits: int, signed: bool) -> None:
    """State the pixels of a gray image; set more for colour."""
    header.SamplesPerPixel = 1
    header.PhotometricInterpretation = "MONOCHROME2"
    header.Rows, header.Columns = rows, columns
    header.BitsAllocated = header.BitsStored = bits
    header.HighBit = bits - 1
    header.PixelRepresentation = int(signed)


def describe_rgb(header: Dataset, rows: int, columns: int) -> None:
    """State the pixels of an RGB image of 8 bits, colour by pixel."""
    describe_pixels(header, rows, columns, 8, signed=False)
    header.SamplesPerPixel = 3
    header.PhotometricInterpretation = "RGB"
    header.PlanarConfiguration = 0


def dicom_bytes(header: Dataset) -> bytes:
    """Return a header, and pixels if it holds them, as they stand in a file.

    Written to memory first, because pydicom buries a full disk in a traceback of text.
    """
    stream = io.BytesIO()
    dcmwrite(stream, header, enforce_file_format=True)
    return stream.getvalue()
