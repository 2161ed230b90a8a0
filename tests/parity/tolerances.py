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

# The deformation network in 8-bit integers against float32, mm. Of random networks that answer 1 mm RMS per
# axis; trained ones come several times nearer (bench_deformer).
INT8_RMS_MM = 0.08
INT8_MOST_MM = 0.4
