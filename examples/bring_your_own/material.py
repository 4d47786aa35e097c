"""Young's modulus and Poisson's ratio from a tensile test: slopes at no load.

The numbers in ``tensile_test.csv`` are made up, to be replaced by measured ones.
"""

from pathlib import Path

import numpy as np

LENGTH, WIDTH, AREA = 60.0, 10.0, 10.0 * 4.0  # mm, mm, mm2, of the strip at rest


def fit(path: Path) -> tuple[float, float]:
    """E (Pa) and ν.

    Stress over strain and lateral over axial strain are lines in the strain, nearly; where
    they meet strain zero are the moduli of small strains, which scenes ask for.
    """
    elongation, force, width = np.loadtxt(path, delimiter=",", skiprows=2, unpack=True)
    strain = elongation / LENGTH
    stress = 1e6 * force / AREA
    young = np.polyfit(strain, stress / strain, 1)[1]
    poisson = np.polyfit(strain, (1.0 - width / WIDTH) / strain, 1)[1]
    return float(young), float(poisson)


if __name__ == "__main__":
    young, poisson = fit(Path(__file__).parent / "tensile_test.csv")
    print(f"young = {young:.3g}  # Pa\npoisson = {poisson:.2f}")
