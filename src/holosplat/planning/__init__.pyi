from .contrast import Setup as Setup
from .contrast import Subject as Subject
from .contrast import Visibility as Visibility
from .contrast import visibility as visibility
from .plan import Plan as Plan
from .plan import Recording as Recording
from .plan import Survey as Survey
from .plan import survey as survey
