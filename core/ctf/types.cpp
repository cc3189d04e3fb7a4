#include "ctf/types.hpp"

#include <stdexcept>

namespace chainshaper::ctf {
namespace {

constexpr std::int64_t largest_alignment = std::int64_t{1} << 20;
constexpr std::int64_t longest_array = std::int64_t{1} << 31;

void check_alignment(std::int64_t align) {
  if (align <= 0 || align > largest_alignment || (align & (align - 1)) != 0)
    throw std::invalid_argument("alignment " + std::to_string(align) + " is no power of two");
}

void check_fields(const std::vector<Field> & fields) {
  for (const Field & field : fields)
    if (!field.type) throw std::invalid_argument("field " + field.name + " has no type");
}

void check(const Integer & integer) {
  if (integer.size < 1 || integer.size > 64)
    throw std::invalid_argument("integer of " + std::to_string(integer.size) + " bits");
  check_alignment(integer.align);
}

void check(const String & /*string*/) {}

void check(const Array & array) {
  if (!array.element) throw std::invalid_argument("array of no type");
  const auto * length = std::get_if<std::int64_t>(&array.length);
  if (length != nullptr && (*length < 0 || *length > longest_array))
    throw std::invalid_argument("array of " + std::to_string(*length) + " elements");
}

void check(const Structure & structure) {
  check_alignment(structure.align);
  check_fields(structure.fields);
}

void check(const Variant & variant) { check_fields(variant.options); }

}  // namespace

std::int64_t alignment(const Type & type) {
  const Kind * kind = type.get();
  while (const auto * array = std::get_if<Array>(&kind->is)) kind = array->element.get();
  if (const auto * integer = std::get_if<Integer>(&kind->is)) return integer->align;
  if (const auto * structure = std::get_if<Structure>(&kind->is)) return structure->align;
  return std::holds_alternative<String>(kind->is) ? 8 : 1;
}

Type checked(Kind kind) {
  std::visit([](const auto & type) { check(type); }, kind.is);
  return std::make_shared<const Kind>(std::move(kind));
}

}  // namespace chainshaper::ctf
