"""Files, resources, versions, interrupts, tables and the compiler: nothing of the bench."""
