"""Scipy's sparse matrices as torch's."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from scipy.sparse import csr_array, csr_matrix
from torch import Tensor


def torch_csr(matrix: csr_matrix | csr_array, dtype: torch.dtype) -> Tensor:
    """The same matrix as a CSR tensor of `dtype`, its columns sorted within each row."""
    matrix.sort_indices()
    starts, columns = (torch.from_numpy(a.astype(np.int64)) for a in (matrix.indptr, matrix.indices))
    with warnings.catch_warnings():  # torch calls its CSR support beta
        warnings.simplefilter("ignore")
        values = torch.from_numpy(matrix.data).to(dtype)
        return torch.sparse_csr_tensor(starts, columns, values, size=matrix.shape, check_invariants=True)
