"""Numbers of the unknown-rate lifetime, for the kernels and for tensors alike.

The polynomials of the exponential integral were fitted with 50 digits; highest power first.
"""

SERIES = (
    1.5013750012591917e-09, -2.5841256043524532e-08, 3.0396444844847993e-07, -3.0983732358297067e-06,
    2.834370254941879e-05, -0.00023148114958617023, 0.0016666665955014242, -0.010416666657736743,
    0.05555555555497918, -0.24999999999998546, 0.9999999999999999,
)  # fmt: skip
"""`(E1(x) + log x + gamma) / x` on [0, 1]: minimax, relative error 6e-17."""

NUMERATOR = (
    0.0, 1.0, 34.37770363805674, 443.9946033752262, 2760.421672406844, 8820.41760460935, 14380.479978636853,
    11221.149807748383, 3633.612499628075, 352.431272111798, 2.3847401717119427,
)  # fmt: skip
DENOMINATOR = (
    1.0, 35.37770363805599, 477.37230701372374, 3173.0385720540626, 11226.977793969772, 21396.548962835925,
    21270.39202563451, 10171.588737098129, 1983.5082469855927, 106.49313334660272, 1e-300,
)  # fmt: skip
"""`NUMERATOR(x) / DENOMINATOR(x)` is `e^x E1(x)` from 1 on: minimax, relative error 4e-16, no zeros and no poles.

The last coefficient stands for 0 and keeps the reciprocal finite where x is 0 and the quotient is not asked for.
"""

TINY_TIME = 1e-80
"""Stands for time 0 where a logarithm or a quotient is taken: S is 1 there to every digit."""
GAMMA = 0.5772156649015329
"""Euler's constant."""
DIFFERENCE_TRUSTED = 2e-4
"""Odds of dying in a gap above which a difference of survivals has lost less than four digits."""
NODE = 0.28867513459481287
"""Gauss-Legendre quadrature with two points: half a gap over the square root of three either side of its middle."""
