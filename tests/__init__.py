"""Tests of radarsdf. Threads sleep while they wait: in several processes, threads that spin make fits a seventh slower."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before any library of OpenMP is loaded
