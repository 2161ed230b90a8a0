// Reads:   SH_COUNT (1, 4, 9 or 16 coefficients per channel), SH_VEC4S.
// Defines: eval_sh.
// Maths:   real spherical harmonics in the order and signs of 3D Gaussian Splatting (Kerbl et al. 2023), as in sh.h,
//          evaluated towards the Gaussian in the head-fixed frame (fact 28); colour = 0.5 + sum, clamped at 0.

// Coefficient i of the three channels, out of tightly packed vec4s.
#define SH_AT(j) coefficients[(j) / 4][(j) % 4]
#define SH(i) vec3(SH_AT(3 * (i)), SH_AT(3 * (i) + 1), SH_AT(3 * (i) + 2))

vec3 eval_sh(vec4 coefficients[SH_VEC4S], vec3 direction) {
    float x = direction.x, y = direction.y, z = direction.z;
    vec3 sum = 0.28209479177387814 * SH(0);
#if SH_COUNT >= 4
    sum += 0.4886025119029199 * (-y * SH(1) + z * SH(2) - x * SH(3));
#endif
#if SH_COUNT >= 9
    float xx = x * x, yy = y * y, zz = z * z;
    sum += 1.0925484305920792 * (x * y * SH(4) - y * z * SH(5) - x * z * SH(7))
         + 0.31539156525252005 * (2.0 * zz - xx - yy) * SH(6)
         + 0.5462742152960396 * (xx - yy) * SH(8);
#endif
#if SH_COUNT >= 16
    sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * SH(9) + x * (xx - 3.0 * yy) * SH(15))
         + 2.890611442640554 * x * y * z * SH(10)
         - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * SH(11) + x * SH(13))
         + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * SH(12)
         + 1.445305721320277 * z * (xx - yy) * SH(14);
#endif
    return max(sum + 0.5, 0.0);
}
