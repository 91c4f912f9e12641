"""Where things lie in the arrays that the kernels share: no kernel allocates while it works.

``w`` (ROWS, 8) floats are the workspace of one step, ``c`` (CONTACTS, COLUMNS) floats the table of its contacts, ``i``
(INTS,) integers. ``fixed`` (FIXED,) and ``steps`` (K, STEP) hold what a problem says once and per step, see
`planning.fused.pack`.
"""

from __future__ import annotations

CONTACTS = 4
"""Most contacts of a step; with two force components each, a row of the workspace has 8 columns."""

# --- kind of a contact in a program: how many unknowns, which rows --------------------------------------------------
ABSENT, OPEN, CONE, RAY, PUSHING_RAY = 0, 1, 2, 3, 4
"""No force · two components, no row · two, both edges of the cone · one along an edge · one, and it must push."""

# --- contact table, columns -----------------------------------------------------------------------------------------
MU, U_N, U_T, D_N, D_T = 0, 1, 2, 3, 4  # µ (signed for a ray: its slope f_t / f_n), weights, desired force
EO, GO = 5, 11  # Jacobians of the two bodies: normal row (3), tangent row (3)
F_N, F_T = 17, 18  # the forces found
C_X, C_Y, N_X, N_Y, TURNS = 19, 20, 21, 22, 23  # point and normal in W; 1 where the normal turns with the go
C_AX, C_AY, C_TX, C_TY = 24, 25, 26, 27  # derivative of the point with angle and travel
F_X, F_Y = 28, 29  # the force in W
COLUMNS = 30

# --- workspace, rows ------------------------------------------------------------------------------------------------
EQUAL = 0  # 3 rows of the eo's balance
EDGES = 3  # 8 rows of the cones
Q, R = 11, 19  # orthonormal basis of the active rows, and the triangle that makes the rows of it; 8 + 8
B = 27  # 3 rows of the go's balance, times √weight
M, L = 30, 33  # the same orthogonal to the active rows, with a unit column each: orthonormal, and their triangle; 3 + 3
T_N, T_T = 36, 37  # (f_n, f_t) per unit of each unknown
TARGET, G = 38, 39  # the unknowns that are wished for, and those found
LOAD_EO, LOAD_GO, ROOT_SLACK = 40, 41, 42  # 3 each
BASE_RHS, LAMBDA, GAMMA = 43, 44, 45  # per row of the basis: right side, multiplier; stationarity per unknown
E0, Z = 46, 47  # 3 each: √weight · slack without forces, and at the solution
NU, OMEGA = 48, 49  # 3 each: multipliers of the two balances, in the units of the balances
LARGEST = 50  # per contact: size of the terms of its stationarity
Y = 51  # 5: the variables in SI
POSE = 52  # x, y, θ of the go; grasp centre x, y; cosine and sine of gocf's angle
POSE_D = 53  # derivative of the go's x, y with the angle, with travel; of the grasp centre with the angle
WRENCH, EE, SENSED = 54, 55, 56  # 3 each: of the sensor on the go in W; X_W_ee; the wrench in gocf
D_TARGET, D_RHS, D_E, D_G, D_Z = 57, 62, 67, 72, 77  # 5 rows each: derivative with each variable of the step
DF = 82  # 4 rows: of (f_n, f_t) of the two object contacts; from here on columns are variables
DW, DEE = 86, 89  # 3 rows each: of the sensor's wrench, of the end-effector
DQ = 92  # 3 rows, columns x, y, θ: of the joints with the end-effector
RES = 95  # of the residual at hand
BY_F, BY_Z, BY_WRENCH, BY_EE = 96, 97, 98, 99  # derivative of the loss by forces (n, t of each), slack, wrench, hand
BACK, BASE_BACK, Z_BACK, NU_BACK = 100, 101, 102, 103  # and by target, right sides, slack of the program, the balance
ROWS = 104

# --- integers -------------------------------------------------------------------------------------------------------
UNKNOWNS, EDGE_ROWS, EQUAL_RANK, RANK, NEXT = 0, 1, 2, 3, 4
CONTACT_OF = 8  # contact of each unknown, 8
CONTACT_OF_EDGE = 16  # contact of each edge row, 8
ROW_OF = 24  # row of each basis vector: 0..2 balance, 3.. edges
INTS = 40

# --- per step -------------------------------------------------------------------------------------------------------
THETA_EO, ANGLE, TRAVEL, LOWEST, HIGHEST, WISH = 0, 1, 2, 3, 4, 5  # wish: 2
EO_X, EO_Y = 7, 8
OBJECT = 9  # per object contact 6: point x, y, face direction x, y, normal x, y
GROUND = 21  # per ground contact 2: lever x, y in W
SLOPE = 25  # per contact: µ, or the slope of its ray
STEP = 29

# --- once -----------------------------------------------------------------------------------------------------------
SCALE = 0  # 5
GO_WEIGHT, EO_WEIGHT, RHO, LENGTH, U_OBJECT = 5, 6, 7, 8, 9
GRASP, GRASP_TURN = 11, 73  # x, y, θ; cosine and sine of θ
STIFFNESS, COMPLIANCE = 14, 23  # 9 each
P_GO = 32  # per object contact 2, in the go's frame
FACE_GO = 36  # 2: direction of the go's face
SLACK = 38  # 3, weights in the program
W_CONE, W_PULL, W_SMOOTH, W_FORCE, W_PENETRATION, W_SLACK, W_TRACK, W_WORKSPACE, W_JOINTS, W_SENSOR = range(41, 51)
WORK_MIDDLE, WORK_HALF = 51, 54  # 3 each
BASE, UPPER, FORE, TOOL, ELBOW, ZERO = 57, 59, 60, 61, 63, 64  # the arm
JOINT_MIDDLE, JOINT_HALF = 67, 70  # 3 each
MOST_FORCE, MOST_TORQUE = 75, 76
FIXED = 77

# --- flags ----------------------------------------------------------------------------------------------------------
PAPER, TWO_BODIES, OBJECTS, GROUNDS, CORNERS, WORKSPACE, JOINTS, MOST_F, MOST_T = range(9)
FLAGS = 9
"""CORNERS has bit 0 or 1 where the first or second contact is a corner of the go on a face; the last four: a limit."""
