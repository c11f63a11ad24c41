// Memory of the engine: 64-byte aligned, grow-only, uninitialised, on huge pages where the system offers them.
#pragma once
#include <cstddef>
#include <cstdlib>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif
#if defined(_WIN32)
#include <malloc.h>
#endif

namespace tgb {

inline void* aligned_allocate(size_t alignment, size_t bytes) {
#if defined(_WIN32)
  return _aligned_malloc(bytes, alignment);
#else
  return aligned_alloc(alignment, bytes);
#endif
}

inline void aligned_release(void* memory) {
#if defined(_WIN32)
  _aligned_free(memory);
#else
  free(memory);
#endif
}

// Fresh pages cost more than the work done in them (14-60 ms for 15 MB), so a buffer keeps what it once had.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { aligned_release(data_); }

  // Memory for at least `count` items; the former contents are lost when it has to grow.
  T* need(size_t count) {
    if (count > capacity_) {
      aligned_release(data_);
      capacity_ = count + count / 4 + 1024;
      const size_t huge = size_t{2} << 20, raw = capacity_ * sizeof(T), alignment = raw >= huge / 2 ? huge : 64;
      const size_t bytes = (raw + alignment - 1) / alignment * alignment;
      data_ = static_cast<T*>(aligned_allocate(alignment, bytes));
      if (data_ == nullptr) {
        capacity_ = 0;
        throw std::bad_alloc();
      }
#if defined(__linux__)
      if (alignment == huge) madvise(data_, bytes, MADV_HUGEPAGE);
#endif
    }
    return data_;
  }
  T* data() const { return data_; }
  T& operator[](size_t index) const { return data_[index]; }
  void swap(Buffer& other) {
    T* data = data_;
    const size_t capacity = capacity_;
    data_ = other.data_, capacity_ = other.capacity_;
    other.data_ = data, other.capacity_ = capacity;
  }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace tgb
