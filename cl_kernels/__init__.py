"""OpenCL C sources, shipped as package data (see pagas_cl.runtime.program)."""
