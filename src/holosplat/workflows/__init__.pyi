from .correct import CorrectionOptions as CorrectionOptions
from .evaluate import Evaluation as Evaluation
from .evaluate import render as render
from .reconstruct import Reconstruction as Reconstruction
from .reconstruct import load_reconstruction as load_reconstruction
from .rehearsal import Rehearsal as Rehearsal
from .rehearsal import rehearse as rehearse
from .run_folder import RunFolder as RunFolder
