"""Which of MediaPipe's 478 face landmarks are what. Right and left are the person's."""

from __future__ import annotations

OVAL = (
    *(10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377),
    *(152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109),
)
"""The face's outline: it slides over the surface as the head turns, so it says little."""
CHIN = (148, 152, 377, 176, 400)
"""The part of the outline that shows how far the jaw is open."""
RIGHT_LIDS = (33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246)
LEFT_LIDS = (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466)
"""The rims of the lids; the outer corner is the first, the inner one the ninth."""
BROWS = (70, 63, 105, 66, 107, 46, 53, 52, 65, 55, 300, 293, 334, 296, 336, 276, 283, 282, 295, 285)
OUTER_LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
INNER_LIPS = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
"""Around the mouth: the right corner, along the lower lip, the left corner, back along the upper lip."""
NOSE = (168, 6, 197, 195, 5, 4, 1, 19, 94, 2, 98, 97, 326, 327, 48, 278, 64, 294)
FEATURES = (*RIGHT_LIDS, *LEFT_LIDS, *BROWS, *OUTER_LIPS, *INNER_LIPS, *NOSE)
RIGID = (
    *(168, 6, 197, 195, 5, 4, 1, 19, 94, 2, 98, 327, 48, 278, 64, 294, 33, 133, 362, 263),
    *(9, 8, 151, 127, 356, 234, 454, 116, 345, 117, 346, 118, 347, 50, 280, 101, 330),
)
"""Points that expressions hardly move, for the first look at the head's pose."""
GAPS = (
    *((159, 145), (158, 153), (160, 144), (386, 374), (385, 380), (387, 373)),  # lids
    *((13, 14), (82, 87), (312, 317), (81, 178), (311, 402), (78, 308), (0, 17)),  # lips
)
"""Pairs whose distance is what the eye sees first: whether lids and lips are open."""
