"""The compressible neo-Hookean solid at a point: energy density, stress and its derivative, in the form one reads.

The source paper (Sun et al., "Computational Design of Self-actuated Deformable Solids via Shape Memory Material")
prints this energy in its equations (1), (18) and (19) and its stresses in (2) and (3). Read them with two corrections:
the bracket of (1), (18), (19) is J^(-2/3) I1 - 3 (as printed, the rest state is under stress), and the factor of
tr(C) C^-1 in (2) is mu/3, not mu/2. Then (2) and (3) are the derivatives of (1).

Moduli mu, kappa are in MPa, scalars or (m,); deformation gradients F (m, 3, 3) must have J = det F > 0.
"""

import numpy as np

from fab4d.mesh.tetmesh import FloatArray

Modulus = float | FloatArray


def energy_density(F: FloatArray, mu: Modulus, kappa: Modulus) -> FloatArray:
    """psi = mu/2 (J^(-2/3) I1 - 3) + kappa/2 (J - 1)^2 with I1 = F:F.

    F : (m, 3, 3)        Returns (m,), MPa.        Source: the paper, (1), (18), (19), corrected.
    """
    J = np.linalg.det(F)
    I1 = _contract(F, F)
    return 0.5 * mu * (J ** (-2 / 3) * I1 - 3.0) + 0.5 * kappa * (J - 1.0) ** 2


def first_piola(F: FloatArray, mu: Modulus, kappa: Modulus) -> FloatArray:
    """P = dpsi/dF = mu J^(-2/3) (F - I1/3 G) + kappa (J - 1) J G with G = F^-T.

    F : (m, 3, 3)        Returns (m, 3, 3), MPa.        Source: the paper, (2) corrected and (3).
    """
    J, G = np.linalg.det(F), _inverse_transpose(F)
    I1 = _contract(F, F)
    m = mu * J ** (-2 / 3)
    return _times(m, F) + _times(kappa * (J - 1.0) * J - m * I1 / 3.0, G)


def stress_tangent(F: FloatArray, H: FloatArray, mu: Modulus, kappa: Modulus) -> FloatArray:
    """dP[H], the change of P for a change H of F.

    dP[H] = mu J^(-2/3) (H - 2/3 (F:H) G + I1/3 G H^T G - 2/3 (G:H)(F - I1/3 G))
            + kappa ((2J - 1) J (G:H) G - (J - 1) J G H^T G)
    F, H : (m, 3, 3)        Returns (m, 3, 3), MPa.        Source: derivative of `first_piola`.
    """
    J, G = np.linalg.det(F), _inverse_transpose(F)
    I1, FH, GH = _contract(F, F), _contract(F, H), _contract(G, H)
    GHG = G @ np.swapaxes(H, -1, -2) @ G
    m = mu * J ** (-2 / 3)
    deviatoric = H - _times(2 / 3 * FH, G) + _times(I1 / 3, GHG) - _times(2 / 3 * GH, F - _times(I1 / 3, G))
    volumetric = _times(kappa * (2 * J - 1) * J * GH, G) - _times(kappa * (J - 1) * J, GHG)
    return _times(m, deviatoric) + volumetric


def _inverse_transpose(F: FloatArray) -> FloatArray:
    return np.swapaxes(np.linalg.inv(F), -1, -2)


def _contract(A: FloatArray, B: FloatArray) -> FloatArray:
    """A:B of each pair of tensors."""
    return np.einsum("...ij,...ij->...", A, B)


def _times(factor: FloatArray, A: FloatArray) -> FloatArray:
    """Each tensor times its own number."""
    return np.asarray(factor)[..., None, None] * A
