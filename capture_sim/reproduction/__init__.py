"""The paper's numerical section and its experiments, run and set beside what it says."""
