"""A scene as a library in C and as a unit of FMI 3.0; neither needs Python."""
