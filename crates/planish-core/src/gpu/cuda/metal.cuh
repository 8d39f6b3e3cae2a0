// Metal's types and functions for CUDA's compiler, as far as naga generates them (translate.rs). NVRTC's option
// --device-as-default-execution-space makes every function a device function.

namespace metal {

typedef unsigned int uint;

template <class T, int N> struct Vector;

// Components of a vector in any order; converts to a vector V where one is needed.
template <class V, class T, int SIZE, int... AT> struct Swizzle {
    T v[SIZE];
    operator V() const { return V(v[AT]...); }
};

// Members of vectors of all sizes. `v` is the array of their components.
#define OPERATOR(OP)                                                   \
    friend Vector operator OP(Vector a, Vector b) {                    \
        for (int i = 0; i < SIZE; i++) a.v[i] = a.v[i] OP b.v[i];      \
        return a;                                                      \
    }
#define COMPARISON(OP)                                                 \
    friend Vector<bool, SIZE> operator OP(Vector a, Vector b) {        \
        Vector<bool, SIZE> is;                                         \
        for (int i = 0; i < SIZE; i++) is.v[i] = a.v[i] OP b.v[i];     \
        return is;                                                     \
    }
#define MEMBERS                                                        \
    Vector() = default;                                                \
    constexpr Vector(T same) : v{} {                                   \
        for (int i = 0; i < SIZE; i++) v[i] = same;                    \
    }                                                                  \
    template <class U> explicit Vector(Vector<U, SIZE> from) {         \
        for (int i = 0; i < SIZE; i++) v[i] = T(from.v[i]);            \
    }                                                                  \
    T &operator[](uint i) { return v[i]; }                             \
    T operator[](uint i) const { return v[i]; }                        \
    friend Vector operator-(Vector a) {                                \
        for (int i = 0; i < SIZE; i++) a.v[i] = -a.v[i];               \
        return a;                                                      \
    }                                                                  \
    OPERATOR(+) OPERATOR(-) OPERATOR(*) OPERATOR(/) OPERATOR(%)        \
    COMPARISON(<) COMPARISON(>) COMPARISON(<=) COMPARISON(>=)          \
    COMPARISON(==) COMPARISON(!=)

#define PAIR(a, i, b, j) Swizzle<Vector<T, 2>, T, SIZE, i, j> a##b;
#define TRIPLE(a, i, b, j, c, k) Swizzle<Vector<T, 3>, T, SIZE, i, j, k> a##b##c;
#define PAIRS(a, i) PAIR(a, i, x, 0) PAIR(a, i, y, 1)
#define TRIPLES_OF(a, i, b, j) TRIPLE(a, i, b, j, x, 0) TRIPLE(a, i, b, j, y, 1) TRIPLE(a, i, b, j, z, 2)
#define TRIPLES(a, i) TRIPLES_OF(a, i, x, 0) TRIPLES_OF(a, i, y, 1) TRIPLES_OF(a, i, z, 2)

template <class T> struct Vector<T, 2> {
    static constexpr int SIZE = 2;
    union {
        T v[2];
        struct { T x, y; };
        PAIRS(x, 0) PAIRS(y, 1)
    };
    constexpr Vector(T x, T y) : v{x, y} {}
    MEMBERS
};

template <class T> struct Vector<T, 3> {
    static constexpr int SIZE = 3;
    union {
        T v[3];
        struct { T x, y, z; };
        PAIRS(x, 0) PAIRS(y, 1) PAIRS(z, 2)
        PAIR(x, 0, z, 2) PAIR(y, 1, z, 2) PAIR(z, 2, z, 2)
        TRIPLES(x, 0) TRIPLES(y, 1) TRIPLES(z, 2)
    };
    constexpr Vector(T x, T y, T z) : v{x, y, z} {}
    constexpr Vector(Vector<T, 2> xy, T z) : v{xy.v[0], xy.v[1], z} {}
    constexpr Vector(T x, Vector<T, 2> yz) : v{x, yz.v[0], yz.v[1]} {}
    MEMBERS
};

template <class T> struct Vector<T, 4> {
    static constexpr int SIZE = 4;
    union {
        T v[4];
        struct { T x, y, z, w; };
        PAIR(x, 0, y, 1) PAIR(z, 2, w, 3) TRIPLE(x, 0, y, 1, z, 2)
    };
    constexpr Vector(T x, T y, T z, T w) : v{x, y, z, w} {}
    constexpr Vector(Vector<T, 3> xyz, T w) : v{xyz.v[0], xyz.v[1], xyz.v[2], w} {}
    constexpr Vector(Vector<T, 2> xy, Vector<T, 2> zw) : v{xy.v[0], xy.v[1], zw.v[0], zw.v[1]} {}
    MEMBERS
};

typedef Vector<float, 2> float2;
typedef Vector<float, 3> float3;
typedef Vector<float, 4> float4;
typedef Vector<int, 2> int2;
typedef Vector<int, 3> int3;
typedef Vector<int, 4> int4;
typedef Vector<uint, 2> uint2;
typedef Vector<uint, 3> uint3;
typedef Vector<uint, 4> uint4;
typedef Vector<bool, 2> bool2;
typedef Vector<bool, 3> bool3;
typedef Vector<bool, 4> bool4;
// Used for local variables only; no buffer contains them.
typedef float2 packed_float2;
typedef float3 packed_float3;
typedef int2 packed_int2;
typedef int3 packed_int3;
typedef uint2 packed_uint2;
typedef uint3 packed_uint3;

inline float abs(float a) { return fabsf(a); }
inline int abs(int a) { return ::abs(a); }
inline float max(float a, float b) { return fmaxf(a, b); }
inline int max(int a, int b) { return ::max(a, b); }
inline uint max(uint a, uint b) { return ::umax(a, b); }
inline float min(float a, float b) { return fminf(a, b); }
inline int min(int a, int b) { return ::min(a, b); }
inline uint min(uint a, uint b) { return ::umin(a, b); }
inline float sqrt(float a) { return sqrtf(a); }
inline float exp2(float a) { return exp2f(a); }
inline float floor(float a) { return floorf(a); }
inline float ceil(float a) { return ceilf(a); }
inline float rint(float a) { return rintf(a); }
inline float fma(float a, float b, float c) { return fmaf(a, b, c); }
inline float clamp(float a, float low, float high) { return min(max(a, low), high); }
inline int clamp(int a, int low, int high) { return min(max(a, low), high); }
inline uint clamp(uint a, uint low, uint high) { return min(max(a, low), high); }
inline float mix(float a, float b, float share) { return fmaf(b - a, share, a); }
inline float select(float a, float b, bool is) { return is ? b : a; }
inline int select(int a, int b, bool is) { return is ? b : a; }
inline uint select(uint a, uint b, bool is) { return is ? b : a; }
inline uint extract_bits(uint bits, uint from, uint count) {
    return count == 0u ? 0u : (bits >> from) & (0xffffffffu >> (32u - count));
}

// Overloads instead of templates, because a Swizzle converts to a vector only as an argument of a non-template
// function.
#define EACH(V, EXPRESSION)                                            \
    V of;                                                              \
    for (int i = 0; i < V::SIZE; i++) of[i] = EXPRESSION;              \
    return of;
#define NUMBERS(V)                                                     \
    inline V max(V a, V b) { EACH(V, max(a[i], b[i])) }                \
    inline V min(V a, V b) { EACH(V, min(a[i], b[i])) }                \
    inline V clamp(V a, V low, V high) { EACH(V, clamp(a[i], low[i], high[i])) } \
    inline V select(V a, V b, bool is) { return is ? b : a; }          \
    inline V select(V a, V b, Vector<bool, V::SIZE> is) { EACH(V, is[i] ? b[i] : a[i]) }
#define FLOATS(V)                                                      \
    NUMBERS(V)                                                         \
    inline V abs(V a) { EACH(V, fabsf(a[i])) }                         \
    inline V sqrt(V a) { EACH(V, sqrtf(a[i])) }                        \
    inline V exp2(V a) { EACH(V, exp2f(a[i])) }                        \
    inline V floor(V a) { EACH(V, floorf(a[i])) }                      \
    inline V rint(V a) { EACH(V, rintf(a[i])) }                        \
    inline V fma(V a, V b, V c) { EACH(V, fmaf(a[i], b[i], c[i])) }    \
    inline V mix(V a, V b, V share) { EACH(V, mix(a[i], b[i], share[i])) } \
    inline V mix(V a, V b, float share) { EACH(V, mix(a[i], b[i], share)) } \
    inline float dot(V a, V b) {                                       \
        float sum = a[0] * b[0];                                       \
        for (int i = 1; i < V::SIZE; i++) sum = fmaf(a[i], b[i], sum); \
        return sum;                                                    \
    }                                                                  \
    inline float length(V a) { return sqrtf(dot(a, a)); }              \
    inline V normalize(V a) { return a / V(length(a)); }
FLOATS(float2) FLOATS(float3) FLOATS(float4)
NUMBERS(int2) NUMBERS(int3) NUMBERS(uint2) NUMBERS(uint3)

inline bool any(bool2 a) { return a.x || a.y; }
inline bool any(bool3 a) { return a.x || a.y || a.z; }
inline bool any(bool4 a) { return a.x || a.y || a.z || a.w; }
inline bool all(bool2 a) { return a.x && a.y; }
inline bool all(bool3 a) { return a.x && a.y && a.z; }
inline bool all(bool4 a) { return a.x && a.y && a.z && a.w; }
inline float3 cross(float3 a, float3 b) {
    return float3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

enum mem_flags { mem_none, mem_device, mem_threadgroup };
inline void threadgroup_barrier(mem_flags) { __syncthreads(); }

} // namespace metal

// Returns the bits of a value as another type; for a Swizzle, those of its vector.
template <class To, class From> inline To as_type(From from) {
    static_assert(sizeof(To) == sizeof(From), "the same bits");
    To to;
    memcpy(&to, &from, sizeof(to));
    return to;
}

template <class To, class V, class T, int SIZE, int... AT>
inline To as_type(metal::Swizzle<V, T, SIZE, AT...> from) {
    return as_type<To>(V(from));
}

#define kernel static __forceinline__
#define device
#define constant const
#define thread
#define threadgroup
