import sys,pickle,torch
from pathlib import Path
from gscompleter.io.image import read_image
