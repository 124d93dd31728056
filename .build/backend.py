"""PEP 517 build backend: setuptools, kept behind one in-tree module.

A frontend (pip, build) calls the hooks of this module. They are setuptools' own; the compiled pair kernels
are added here, so that `pyproject.toml` never has to change when the way they are built does, and an install
on a machine without a compiler goes through the same door.
"""

from setuptools.build_meta import (  # noqa: F401  (the hooks are re-exported)
    build_editable,
    build_sdist,
    build_wheel,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)
