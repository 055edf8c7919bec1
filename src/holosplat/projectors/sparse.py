"""Sparse matrices of scipy as tensors."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.sparse
import torch
from torch import Tensor


def torch_csr(matrix: scipy.sparse.csr_matrix | scipy.sparse.csr_array, dtype: type[np.floating]) -> Tensor:
    """A matrix with sorted columns as a sparse tensor of the same shape, of numpy's `dtype`."""
    with warnings.catch_warnings():  # torch calls its CSR support beta
        warnings.simplefilter("ignore")
        return torch.sparse_csr_tensor(
            torch.from_numpy(matrix.indptr.astype(np.int64)),
            torch.from_numpy(matrix.indices.astype(np.int64)),
            torch.from_numpy(matrix.data.astype(dtype)),
            size=matrix.shape,
            check_invariants=True,
        )
