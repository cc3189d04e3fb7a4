// Numbers for texts and arrays of bytes: equal ones have the same code, and columns have codes.

#pragma once

#include <cstdint>
#include <vector>

#include "ctf/bits.hpp"

namespace chainshaper::ctf {

// A text, or an array of bytes, in a packet.
struct Text {
  const std::uint8_t * place;
  std::int64_t length;      // bytes
  std::uint64_t digest;     // a hash of its words of 8 bytes
  std::uint64_t last_word;  // the bytes behind the last full word, 0 to 7, then zeros
};

// Reads the characters of `bytes` from byte `at` up to `limit`, which is not before it; of a text
// only those before the first NUL. Bytes from the limit on count as NULs.
inline Text text_at(Bytes bytes, std::int64_t at, std::int64_t limit, bool is_text) {
  constexpr std::uint64_t ones = 0x0101010101010101, highs = 0x8080808080808080;
  constexpr std::uint64_t factor = 0x9E3779B97F4A7C15;
  Text text{bytes.data() + at, limit - at, factor, 0};
  // The last word is the first word that is not full; it may be empty.
  bool is_last = false;
  for (auto place = at; !is_last; place += 8) {
    auto word = word_at(bytes, place);
    is_last = place + 8 > limit;
    if (is_last) word = low_bits(word, 8 * (limit - place));
    // Has the top bit of each byte that is 0. Behind the first such byte it may have top bits of
    // other bytes, too.
    const auto zeros = is_text ? (word - ones) & ~word & highs : 0;
    if (zeros != 0) {
      is_last = true;
      word &= ((zeros & (0 - zeros)) >> 7) - 1;
      text.length = place - at + (std::countr_zero(zeros) >> 3);
    }
    text.last_word = word;
    text.digest = (text.digest ^ word) * factor;
    text.digest ^= text.digest >> 29;
  }
  return text;
}

// The dictionary of a run of the decoder. The bytes of texts stay in their packets, which must live
// as long.
class Texts {
public:
  // Returns the code of a text; codes count up from 0 in order of first use.
  std::uint32_t code(const Text & text) {
    auto slot = first_slot(text);
    for (; slots_[slot] != 0; slot = (slot + 1) & mask()) {
      const auto code = slots_[slot] - 1;
      if (same(texts_[code], text)) return code;
    }
    return add(text, slot);
  }

  const std::vector<Text> & all() const { return texts_; }

private:
  std::size_t mask() const { return slots_.size() - 1; }

  std::size_t first_slot(const Text & text) const {
    return static_cast<std::size_t>(text.digest >> 32) & mask();
  }

  // Compares all words but a full word at the end of the text. That one is the same if the digests
  // are: after equal words, a different word gives a different digest.
  static bool same(const Text & known, const Text & text) {
    if (known.digest != text.digest || known.length != text.length ||
        known.last_word != text.last_word)
      return false;
    for (std::int64_t index = 0; index + 8 < text.length; index += 8)
      if (load<std::uint64_t>(known.place + index) != load<std::uint64_t>(text.place + index))
        return false;
    return true;
  }

  std::uint32_t add(const Text & text, std::size_t slot) {
    texts_.push_back(text);
    const auto code = static_cast<std::uint32_t>(texts_.size() - 1);
    slots_[slot] = code + 1;
    if (2 * texts_.size() > slots_.size()) grow();
    return code;
  }

  void grow() {
    slots_.assign(4 * slots_.size(), 0);
    for (std::uint32_t code = 0; code < texts_.size(); ++code) {
      auto slot = first_slot(texts_[code]);
      while (slots_[slot] != 0) slot = (slot + 1) & mask();
      slots_[slot] = code + 1;
    }
  }

  std::vector<Text> texts_;  // by code
  // 1 + the code, or 0: free. Their number is a power of two, and at least half of them are free.
  std::vector<std::uint32_t> slots_ = std::vector<std::uint32_t>(1024);
};

}  // namespace chainshaper::ctf
