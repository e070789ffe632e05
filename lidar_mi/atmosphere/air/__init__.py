"""Air that moves beside a wake: turbulence, gusts, shear, a microburst, and their sum.

Level frame of all of them: x forward along the path's horizontal projection, from where the
aircraft is at time 0; y left; z the height above the ground. It moves with the mean wind at the
height of the start, so that a uniform wind changes nothing.
"""
