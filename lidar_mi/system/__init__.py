"""The machine: its LLVM, and what it can run."""
