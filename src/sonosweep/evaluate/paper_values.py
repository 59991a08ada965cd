"""The numbers the paper prints, for tables of their own: they are not comparable with ours."""

from dataclasses import dataclass
from typing import Literal

from sonosweep.evaluate.tables import Cell, markdown_table

PaperTable = Literal["dataset1", "ablation1", "ablation2", "dataset3"]

COLUMNS = ("rAE", "aAE", "rFE", "aFE", "Corr", "FDR")
NOT_COMPARABLE = (
    "They are not comparable with the numbers above: they are of recorded sweeps of people"
    " against a tracker, with networks of full size that were trained on such sweeps; ours"
    " are of simulated sweeps with exact truth. rAE and aAE are means of mm and"
    " degrees in one; the paper prints mm as the unit of FDR, its values are per cent, and its"
    " text divides by the length of the path where the released code divides by the chord."
)


@dataclass(frozen=True)
class PaperNumbers:
    """One table of the paper.

    Attributes:
        title: Which.
        rows: Six numbers of each row, in the order of :data:`COLUMNS`.
    """

    title: str
    rows: dict[str, tuple[float, float, float, float, float, float]]


PAPER_TABLES: dict[PaperTable, PaperNumbers] = {
    "dataset1": PaperNumbers(
        "Model Performance, In-House Dataset (data set 1: 18 test sweeps of 3 people)",
        {
            "CNN": (0.1946, 17.9297, 0.5045, 40.5307, 0.5282, 32.7253),
            "DCL": (0.1272, 14.6046, 0.3463, 39.4931, 0.8464, 29.5583),
            "DC2": (0.1361, 11.2227, 0.3584, 29.8875, 0.8775, 21.3799),
            "Efficient": (0.1177, 10.5001, 0.3214, 25.4893, 0.7999, 21.8983),
            "LSTM": (0.1159, 8.8340, 0.3212, 21.9479, 0.8826, 15.5101),
            "MoGLo": (0.1047, 6.9254, 0.2917, 16.1944, 0.9217, 12.0577),
        },
    ),
    "ablation1": PaperNumbers(
        "Ablation Study 1: global-local attention (G), correlation (C), motion-based MAE (M)",
        {
            "none": (0.1142, 8.6565, 0.3127, 20.1755, 0.8723, 17.4204),
            "G": (0.1091, 8.4476, 0.3002, 18.8602, 0.9008, 14.6913),
            "C": (0.1109, 8.4749, 0.3074, 20.3687, 0.8806, 14.8185),
            "M": (0.1123, 8.2902, 0.3081, 19.8897, 0.8900, 15.7800),
            "G, C": (0.1094, 7.2300, 0.3018, 16.7405, 0.9060, 14.1837),
            "G, M": (0.1083, 7.0348, 0.2981, 17.0640, 0.9002, 13.5590),
            "C, M": (0.1087, 8.0705, 0.3019, 19.1706, 0.8998, 15.1482),
            "G, C, M": (0.1047, 6.9254, 0.2917, 16.1944, 0.9217, 12.0577),
        },
    ),
    "ablation2": PaperNumbers(
        "Ablation Study 2: what the network reads",
        {
            "Log (before log compression)": (0.1127, 9.7552, 0.3105, 25.5322, 0.8790, 18.9047),
            "IQ (with B-mode)": (0.1115, 7.3152, 0.3157, 18.8984, 0.8925, 13.5999),
            "SP (Lee filter)": (0.1088, 7.8099, 0.2988, 18.9144, 0.9021, 14.8614),
            "MoGLo (B-mode)": (0.1047, 6.9254, 0.2917, 16.1944, 0.9217, 12.0577),
        },
    ),
    "dataset3": PaperNumbers(
        "Model Performance, Open Dataset (data set 3)",
        {
            "CNN": (0.2183, 9.9857, 0.5866, 29.8432, 0.7749, 37.1222),
            "DCL": (0.1988, 9.1184, 0.5281, 27.2999, 0.8131, 34.9391),
            "DC2": (0.1947, 8.8892, 0.5146, 27.1966, 0.8206, 35.1307),
            "Efficient": (0.1853, 7.5940, 0.4495, 19.5572, 0.8672, 27.0905),
            "LSTM": (0.1815, 7.1584, 0.4437, 19.5029, 0.8751, 25.1588),
            "MoGLo": (0.1745, 6.7183, 0.4183, 17.8089, 0.8940, 22.6942),
        },
    ),
}


def paper_numbers_table(name: PaperTable) -> str:
    """Return one table of the paper as Markdown, with its title and why it stands alone."""
    table = PAPER_TABLES[name]
    rows: list[dict[str, Cell]] = [
        {"model": model, **dict(zip(COLUMNS, numbers, strict=True))}
        for model, numbers in table.rows.items()
    ]
    return f"{table.title}. {NOT_COMPARABLE}\n\n{markdown_table(rows, digits=4)}"
