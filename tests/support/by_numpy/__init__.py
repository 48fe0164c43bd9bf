"""The per-frame arithmetic once more, with NumPy: what the compiled functions are held against.

Written for reading, independently of the loops that numba compiles; each module has the functions of one of the
package's kernels.
"""
