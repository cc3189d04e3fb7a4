// Keys of rows, and a hash table from keys to values.

#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>
#include <vector>

namespace chainshaper::matching {

// Up to three numbers: a process, a thread, an address. Unused ones are 0.
struct Key {
  std::int64_t first{0};
  std::int64_t second{0};
  std::int64_t third{0};

  bool operator==(const Key & key) const {
    return first == key.first && second == key.second && third == key.third;
  }
};

inline constexpr std::size_t most_key_columns = 3;

// The keys of a table's rows, which are read from its columns without copying these. Numbers are
// compared by their bits, signed or not; numbers of 32 bits are extended by 0s.
class Keys {
public:
  // Adds a column of 32 or 64 bits, with as many rows as the table. At most three can be added.
  template <typename Number>
  void add(std::span<const Number> rows) {
    static_assert(sizeof(Number) == 4 || sizeof(Number) == 8);
    columns_.at(count_++) = {reinterpret_cast<const std::byte *>(rows.data()), sizeof(Number)};
  }

  Key at(std::size_t row) const {
    return {columns_[0].at(row), columns_[1].at(row), columns_[2].at(row)};
  }

private:
  struct Column {
    const std::byte * rows{nullptr};
    std::size_t width{0};  // bytes; 0 for a column that is not used

    std::int64_t at(std::size_t row) const {
      if (width == 8) return load<std::int64_t>(row);
      return width == 4 ? load<std::uint32_t>(row) : 0;
    }

    template <typename Number>
    Number load(std::size_t row) const {
      Number number;
      std::memcpy(&number, rows + row * sizeof number, sizeof number);
      return number;
    }
  };

  std::array<Column, most_key_columns> columns_{};
  std::size_t count_{0};
};

// An open hash table that grows as needed; nothing can be removed.
template <typename Value>
class KeyTable {
public:
  // Returns the value of a key; nullptr: it was never added.
  Value * find(Key key) {
    Place & place = place_of(key);
    return place.taken ? &place.value : nullptr;
  }

  // Returns the value of a key, which is added if it was not before. Valid until the next call.
  Value & operator[](Key key) {
    Place * place = &place_of(key);
    if (!place->taken) {
      if (2 * ++count_ > places_.size()) {
        grow();
        place = &place_of(key);
      }
      *place = {key, Value{}, true};
    }
    return place->value;
  }

private:
  struct Place {
    Key key{};
    Value value{};
    bool taken{false};
  };

  static std::size_t hash(Key key) {
    auto mixed = (static_cast<std::uint64_t>(key.first) * 0x9E3779B97F4A7C15) ^
                 (static_cast<std::uint64_t>(key.second) * 0xC2B2AE3D27D4EB4F);
    mixed = (mixed ^ (mixed >> 29)) + static_cast<std::uint64_t>(key.third) * 0x165667B19E3779F9;
    return static_cast<std::size_t>(mixed >> 17);
  }

  // Returns the place of a key, or the free place where it would be; there always is a free one.
  Place & place_of(Key key) {
    const auto mask = places_.size() - 1;
    auto index = hash(key) & mask;
    while (places_[index].taken && !(places_[index].key == key)) index = (index + 1) & mask;
    return places_[index];
  }

  void grow() {
    auto before = std::vector<Place>(4 * places_.size());
    before.swap(places_);
    for (const Place & place : before)
      if (place.taken) place_of(place.key) = place;
  }

  std::vector<Place> places_ = std::vector<Place>(1024);  // a power of two, at least half are free
  std::size_t count_{0};
};

}  // namespace chainshaper::matching
