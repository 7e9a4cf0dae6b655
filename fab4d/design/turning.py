"""Steps of a shape that turn its elements by the whole angle: a straight step in the positions shears them instead.

The change of each deformation gradient is split in a stretch and a rotation, and the shape whose gradients come closest
to those follows from one Poisson equation. Source: Huang et al., "Interactive Shape Interpolation through Controllable
Dynamic Deformation", IEEE TVCG 17 (2011) 983.
"""

import numpy as np
from scipy.sparse import coo_array, csr_array, tril
from scipy.spatial.transform import Rotation

from fab4d.elasticity import _kernels as kernels
from fab4d.elasticity.elements import Discretisation
from fab4d.mesh.tetmesh import FloatArray, IntArray
from fab4d.solvers.linear import analyse

# The straight step is taken as it is where no node moves farther, in L0.
STRAIGHT = 1e-7


class Turning:
    """Bends steps of the shapes of one body; the nodes `fixed` and the means W x come out as in the straight step.

    fixed : (c,) nodes, maybe none        W : (K, N) weights of the patches, rows that sum to 1
    """

    def __init__(self, body: Discretisation, fixed: IntArray, W: csr_array) -> None:
        self._body = body
        self._floating = not len(fixed)
        grounded = fixed if len(fixed) else np.zeros(1, np.int64)
        self._free = np.setdiff1d(np.arange(len(body.X)), grounded)
        lower = _laplacian(body)[self._free][:, self._free]
        lower = tril(lower, format="csc")
        lower.sort_indices()
        indptr, indices = lower.indptr.astype(np.int64), lower.indices.astype(np.int64)
        self._factor = analyse(indptr, indices).factor(lower.data)
        self._W = W.tocsc()[:, self._free]
        self._columns = self._factor.solve_many(self._W.T.toarray()) if W.shape[0] else np.zeros((len(self._free), 0))
        self._small = self._patch_matrix()

    def _patch_matrix(self) -> FloatArray:
        """Matrix of the patches' multipliers; of a floating body, bordered by its free translation."""
        inner = self._W @ self._columns
        if not (self._floating and len(inner)):
            return inner
        ones = np.ones((len(inner), 1))
        return np.block([[inner, -ones], [ones.T, np.zeros((1, 1))]])

    def step(self, x: FloatArray, dx: FloatArray) -> FloatArray:
        """The shape x (N, 3), all det F > 0, after the step dx (N, 3), its elements turned."""
        if np.abs(dx).max() <= STRAIGHT:
            return x + dx
        body = self._body
        load = np.zeros_like(x)
        kernels.turning_load(body.elements, body.dN, body.weights, x - body.X, dx, load)
        return x + dx + self._correction(load, np.zeros((self._W.shape[0], 3)))

    def repeat(
        self, before: FloatArray, after: FloatArray, x: FloatArray, ratio: float = 1.0, gap: FloatArray | None = None
    ) -> FloatArray:
        """The shape x (N, 3) when it moves on as from `before` to `after`, `ratio` times as far.

        gap : (K, 3) how far the means of the patches are to move; None leaves them
        """
        body = self._body
        F0, F1, F = (np.einsum("mai,mqaj->mqij", shape[body.elements], body.dN) for shape in (before, after, x))
        U, s, Vt = np.linalg.svd(F1 @ np.linalg.inv(F0))
        turn = Rotation.from_matrix((U @ Vt).reshape(-1, 3, 3)).as_rotvec()
        R = Rotation.from_rotvec(ratio * turn).as_matrix().reshape(F.shape)
        stretch = np.swapaxes(Vt, -1, -2) @ (s[..., None] ** ratio * Vt)
        change = R @ stretch @ F - F
        load = np.zeros_like(x)
        np.add.at(load, body.elements, np.einsum("mq,mqij,mqaj->mai", body.weights, change, body.dN))
        return x + self._correction(load, np.zeros((self._W.shape[0], 3)) if gap is None else gap)

    def _correction(self, load: FloatArray, gap: FloatArray) -> FloatArray:
        """(N, 3) displacement with gradients nearest to those of `load`, its patch means moving by `gap` (K, 3)."""
        c = np.zeros_like(load)
        found = self._factor.solve_many(load[self._free])
        if len(gap):
            misfit = self._W @ found - gap
            rows = np.vstack([misfit, np.zeros((1, 3))]) if self._floating else misfit
            multipliers = np.linalg.solve(self._small, rows)
            found = found - self._columns @ multipliers[: len(gap)]
            if self._floating:
                c += multipliers[-1]
        c[self._free] += found
        return c


def _laplacian(body: Discretisation) -> csr_array:
    """(N, N) sum_q w dN_a . dN_b."""
    elements, n = body.elements, len(body.X)
    nn = elements.shape[1]
    K = np.einsum("mq,mqai,mqbi->mab", body.weights, body.dN, body.dN)
    rows, columns = np.repeat(elements, nn, axis=1).ravel(), np.tile(elements, (1, nn)).ravel()
    return csr_array(coo_array((K.ravel(), (rows, columns)), shape=(n, n)))
