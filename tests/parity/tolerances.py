"""Every tolerance by which two implementations of the same thing may differ, in one table."""

# Splatting, C++ (float32) against the readable reference (float64).
RGB = ALPHA = DEPTH = 1e-4  # absolute, on pixels away from cut-offs
MEANS2D = 1e-3  # px
FLIP_MARGIN = (
    1e-4  # relative: a pixel where some alpha is this near 1/255, or transmittance this near 1e-4, may flip
)
FLIP_SHARE = 0.02  # of pixels that may be near a flip in a test scene: more would hide errors
FLIP_SIZE = (
    2 / 255
)  # what one flip may change, per unit of colour or metre of depth: a skipped alpha of 1/255, or an end
GRADIENT = (
    1e-3  # relative: of the whole tensor's norm, and of each element plus GRADIENT_FLOOR of the largest
)
GRADIENT_FLOOR = 1e-2  # sums of large terms that cancel keep the absolute error of float32
FINITE_DIFFERENCE = 1e-3  # relative, reference gradients against central differences in double
ISA = 1e-5  # absolute, between instruction sets
ISA_GRADIENT = 2e-2  # of the largest element: what one flip may change

# Triangle binding, C++ (float32) against NumPy (float64), relative to the largest value.
BIND = 2e-6

# The player (float32, onnxruntime) against the facts in float64.
PLAYER_VERTICES = 5e-7  # m
PLAYER_NEUTRAL = 1e-8  # m, the baked neutral correction
PLAYER_MEANS = 1e-6  # m
PLAYER_QUATS = 2e-5  # 1 - |cosine| of unit quaternions
PLAYER_SCALES = 1e-5  # relative
PLAYER_PICTURE = 1  # steps of 255, on all but one pixel in a thousand
PLAYER_HALF_DB = 45  # float16 bundle against float32, PSNR of a picture

# Hard cases of splatting (tests/hard_splats.py), C++ against the reference, away from flips: the picture (per
# unit of colour and metre of depth beyond 1), then the gradients as a share of the norm and in each element
# (as GRADIENT). Each is at most four times the largest error measured on base, v3, v4. Sums of a few hundred
# float32 terms give 1e-6 of a picture and 5e-5 of an element's gradient; what is larger has its reason.
HARD = {
    "near_plane": (6e-7, 8e-6, 6e-5),
    "behind": (1e-8, 0, 0),  # the background, to the bit; 1e-8 is that of its decimals
    "tiny": (8e-6, 8e-6, 1.5e-4),
    "singular": (3e-6, 1e-5, 5e-4),
    "enormous": (2e-6, 1.5e-5, 1.5e-4),
    "colossal": (1e-6, 3e-5, 1e-4),  # near 1 / sigma^2 = 1e-19, where float32 has begun to lose digits
    "every_scale": (1.5e-6, 8e-6, 1.5e-4),
    "covering": (2e-7, 1.2e-6, 3.5e-6),
    "layers": (5e-6, 3e-6, 1.5e-4),
    "saturated": (1e-4, 9e-5, 9e-4),  # log2 of an opacity of 1e38 leaves 17 bits for where it falls to 1/255
    "opaque": (1.2e-6, 4e-6, 1.8e-4),
    "quaternions": (4e-6, 8e-6, 7e-5),
    "far_away": (3e-5, 3e-5, 2e-3),  # positions to 2 um: a camera's pivot is at most 14 m away
    "distant": (2.5e-6, 4e-6, 1.8e-4),
    "denormal": (4e-6, 5e-6, 2.5e-4),
    "bright": (2.5e-6, 4e-6, 1.8e-4),
    "fov_1": (1.8e-6, 3.5e-6, 1.3e-4),
    "fov_170": (5e-6, 4e-6, 1.2e-4),
    "off_centre": (4e-5, 9e-5, 3e-3),  # positions are differences of numbers near 1000 px
    "one_pixel": (4e-7, 8e-5, 3e-3),  # one pixel's terms: what lies in front cancels behind it
    "wide_8192": (2.5e-6, 5e-6, 1.5e-4),
    "high_8192": (3.5e-6, 5e-6, 1.4e-4),
}
HARD_FLIP_SHARE = 0.05  # "layers": with a thousand of them, 3 % of the pixels have some alpha near a cut-off
HARD_MEANS2D = 2e-7  # relative, where that is more than MEANS2D: 24 bits, far outside the image as well

# Binding to slivers, inverted, tiny and huge triangles, each row relative to its own norm.
HARD_BIND = 7e-7  # one rounding of the frame, one or two of the product: frames are computed in double
HARD_BIND_GRADIENT = 3e-5  # plus GRADIENT_FLOOR of the largest row: sums of float32 over a triangle's riders
HARD_BOUND = 1.2e-5  # pictures of riders: frames in float32 unless the triangle is lower than 1 % of its side
HARD_BOUND_FAR = 0.1  # 10 km away posed means have steps of half a millimetre, 0.03 px here

# Rotations near the identity and half turns, to matrix, quaternion, vector and back, in steps of the number.
ROTATION = 25

# The deformation network in 8-bit integers against float32, mm. Of random networks that answer 1 mm RMS per
# axis; trained ones come several times nearer (bench_deformer).
INT8_RMS_MM = 0.08
INT8_MOST_MM = 0.4

# The same in float32, on each instruction set, against torch in float64: of the answers' range.
FLOAT_UNET = 2e-6
