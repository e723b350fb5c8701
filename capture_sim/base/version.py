"""The version of this package; CITATION.cff, package.xml and CHANGELOG state the same version."""

__version__ = "0.2.0"
