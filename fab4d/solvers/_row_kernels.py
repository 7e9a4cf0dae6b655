"""Compiled loops over the lower triangle of a symmetric matrix in CSC form."""
# mypy: disable-error-code="no-untyped-def"

from numba import njit


@njit(cache=True, nogil=True)
def largest_entries(indptr, indices, data, largest):
    """Writes the largest |A_ij| of each row i of the whole matrix to largest (n,), zeros before."""
    for j in range(indptr.shape[0] - 1):
        for k in range(indptr[j], indptr[j + 1]):
            # NaN is not smaller than anything: it has to show in one of the two rows.
            i, size = indices[k], abs(data[k])
            if size > largest[i] or size != size:
                largest[i] = size
            if size > largest[j]:
                largest[j] = size
