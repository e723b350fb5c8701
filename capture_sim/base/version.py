"""The version of this package; CITATION.cff, package.xml and CHANGELOG have the same."""

__version__ = "0.2.0"
