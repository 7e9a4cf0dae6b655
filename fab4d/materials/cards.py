"""The material card: moduli, densities and prices of TPE and of both SMP phases."""

from dataclasses import dataclass

from fab4d.errors import MaterialError


@dataclass(frozen=True)
class Moduli:
    """Shear modulus mu and bulk modulus kappa of one phase, MPa."""

    mu: float
    kappa: float

    @property
    def poisson_ratio(self) -> float:
        """nu = (3 kappa - 2 mu) / (2 (3 kappa + mu))."""
        return (3 * self.kappa - 2 * self.mu) / (2 * (3 * self.kappa + self.mu))


@dataclass(frozen=True)
class MaterialCard:
    """What model.md calls a preset. Densities in g/cm^3, prices in USD/kg, temperatures in K, stretches as ratios.

    The last three are of printing: None where the card does not tell.
    """

    name: str
    tpe: Moduli
    rubbery: Moduli
    glassy: Moduli
    smp_density: float
    tpe_density: float
    smp_price: float
    tpe_price: float
    smp_max_stretch: float
    tpe_max_stretch: float
    transition_temperature: float
    transition_half_width: float
    measured: bool
    source: str
    tpe_service_temperature: float | None = None
    """Up to which TPE keeps its shape in use."""
    smp_max_flow: float | None = None
    """Fastest extrusion, mm^3/s."""
    tpe_max_flow: float | None = None

    def __post_init__(self) -> None:
        for phase in ("tpe", "rubbery", "glassy"):
            moduli = getattr(self, phase)
            if not (moduli.mu > 0 and moduli.kappa > 0):
                msg = (
                    f'material card "{self.name}": {phase} needs mu > 0 and kappa > 0, '
                    f"not {moduli.mu:g} and {moduli.kappa:g} MPa"
                )
                raise MaterialError(msg)

    def warnings(self) -> list[str]:
        """Phases whose Poisson ratio is outside 0..0.499, where linear tets lock or the solid is unusual."""
        found = []
        for phase in ("tpe", "rubbery", "glassy"):
            nu = getattr(self, phase).poisson_ratio
            if nu < 0 or nu > 0.499:
                found.append(f'material card "{self.name}": Poisson ratio of {phase} is {nu:.3f}')
        return found
