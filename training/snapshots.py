"""Pictures while training: a few fixed transfers, drawn small, so that a person sees the network learn."""

import functools
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from training.data import Batch
from training.figures import ROLE_COLORS
from training.inference import predict
from training.rasteriser import Floats, Integers
from training.rendering import Camera, frame, render_mesh

_PANEL = (230, 270)
