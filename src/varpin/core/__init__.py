"""The compiled core. Its C++ is in ``src/core``, one header for each idea, and is built with the package."""

from varpin.core._core import BackwardPass as BackwardPass
from varpin.core._core import CostTerms as CostTerms
from varpin.core._core import ExplicitMethod as ExplicitMethod
from varpin.core._core import ExplicitRollout as ExplicitRollout
from varpin.core._core import ForwardDynamics as ForwardDynamics
from varpin.core._core import Guards as Guards
from varpin.core._core import Links as Links
from varpin.core._core import Mechanism as Mechanism
from varpin.core._core import Outcome as Outcome
from varpin.core._core import Rollout as Rollout
from varpin.core._core import RootPass as RootPass
from varpin.core._core import Squares as Squares
from varpin.core._core import Steps as Steps
from varpin.core._core import Stretch as Stretch
from varpin.core._core import Subject as Subject
from varpin.core._core import Tableau as Tableau
from varpin.core._core import accelerations as accelerations
from varpin.core._core import constrained_derivatives as constrained_derivatives
from varpin.core._core import coupling_kinds as coupling_kinds
from varpin.core._core import element_kinds as element_kinds
from varpin.core._core import foresee as foresee
from varpin.core._core import inverse_dynamics as inverse_dynamics
from varpin.core._core import linearize_explicit as linearize_explicit
from varpin.core._core import propagated_errors as propagated_errors
